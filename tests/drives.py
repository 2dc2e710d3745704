"""Drives on disk, label maps and photos, and what is true of them; shared by the tests."""

import json
from pathlib import Path

import numpy as np
from helpers import write_street
from PIL import Image


def write_maps(folder: Path, seeds: range) -> Path:
    """A sequence of small label maps in ``drawings.SPACE``."""
    for seed in seeds:
        write_street(folder / f"{seed:03d}.png", seed)
    return folder


def write_photos(folder: Path, seeds: range, suffix: str = ".png") -> Path:
    """A sequence of images without meaning, each its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        gray = np.random.default_rng(seed).integers(0, 256, (12, 16), dtype=np.uint8)
        picture = Image.fromarray(gray).resize((128, 96)).convert("RGB")
        picture.save(folder / f"{seed:03d}{suffix}")
    return folder


def write_two_drives(folder: Path, count: int) -> Path:
    """Drives ``query`` and ``reference`` past the same places, with images and label maps."""
    for drive in ("query", "reference"):
        write_photos(folder / drive / "images", range(count), ".jpg")
        write_maps(folder / drive / "labels", range(count))
    return folder


def write_truth(path: Path, content: object) -> Path:
    """A ground truth in the form that the file's name says."""
    if path.suffix == ".npy":
        np.save(path, content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path
