"""Drives of images and label maps in memory, and the batches that a network is trained on.

A batch follows from its number alone, whatever was drawn before it, so that a run that was
killed goes on as if it had not been.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.datasets.label_files import read_label_map
from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.taxonomy import label_space

SPACE = "camvid-11"
VOID = 11
CLASSES = 11
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

ZOOM = 0.25
"""Largest fraction by which a view is wider or narrower, and moved."""


@dataclass(frozen=True)
class Drive:
    """Frames of a drive: ids, ``(n, h, w, 3)`` uint8 images, ``(n, h, w)`` targets of that size,
    and the label maps at the size that they are on disk, ``(n, H, W)``, all uint8."""

    frames: tuple[str, ...]
    images: Tensor
    targets: Tensor
    labels: Tensor

    def rows(self, first: int, last: int) -> Drive:
        """Some frames in a row."""
        part = slice(first, last)
        return Drive(self.frames[part], self.images[part], self.targets[part], self.labels[part])


class Batch(NamedTuple):
    """``(B, 3, h, w)`` normalised images, ``(B, h, w)`` int64 targets, ``(B,)`` rows of the drive,
    ``(B,)`` bool which of them are mirrored."""

    images: Tensor
    targets: Tensor
    rows: Tensor
    mirrored: Tensor


def read_drive(root: Path, name: str, size: tuple[int, int]) -> Drive:
    """A drive of a CamVid folder, in any of its layouts; only frames with image and labels."""
    drives = {drive.name: drive for drive in open_dataset(root, "camvid").traverses}
    if name not in drives:
        raise ValueError(f"{root} has no drive {name!r}; expected one of {', '.join(drives)}")
    frames = [frame for frame in drives[name].frames if frame.image and frame.label]
    if not frames:
        raise ValueError(f"drive {name} of {root} has no frame with an image and a label map")
    images, targets, labels = [], [], []
    for frame in frames:
        picture = Image.fromarray(read_image(FrameFile(name, frame.name, frame.image)))
        label_map = read_label_map(FrameFile(name, frame.name, frame.label), label_space(SPACE))
        images.append(np.asarray(picture.resize(size[::-1], Image.Resampling.BILINEAR)))
        small = Image.fromarray(label_map).resize(size[::-1], Image.Resampling.NEAREST)
        targets.append(np.asarray(small))
        labels.append(label_map)
    stacks = (torch.from_numpy(np.stack(maps)) for maps in (images, targets, labels))
    return Drive(tuple(frame.frame for frame in frames), *stacks)


def draw(drive: Drive, count: int, number: int, zoomed: bool) -> Batch:
    """A batch of random frames, mirrored or not, in other light, and zoomed if wanted."""
    generator = torch.Generator().manual_seed(number)
    rows = torch.randperm(len(drive.frames), generator=generator)[:count]
    mirrored = torch.rand(len(rows), generator=generator) < 0.5
    images = drive.images[rows].permute(0, 3, 1, 2).float() / 255
    targets = drive.targets[rows].long()
    images, targets = (
        torch.where(mirrored.view(-1, *[1] * (part.ndim - 1)), part.flip(-1), part)
        for part in (images, targets)
    )
    if zoomed:
        images, targets = _zoom(images, targets, generator)
    return Batch(normalise(_relight(images, generator)), targets, rows, mirrored)


def normalise(images: Tensor) -> Tensor:
    """Images from 0 to 1 as the network wants them."""
    mean, std = (torch.tensor(three).view(3, 1, 1) for three in (MEAN, STD))
    return (images - mean) / std


def _relight(images: Tensor, generator: torch.Generator) -> Tensor:
    """Another exposure, contrast and colour of the light for each image, and a noisy sensor."""

    def factors(spread: float, channels: int = 1) -> Tensor:
        drawn = torch.rand(len(images), channels, 1, 1, generator=generator) * 2 - 1
        return (drawn * spread).exp()

    exposed = images.clamp(min=1e-3) ** factors(0.6) * factors(0.4) * factors(0.15, 3)
    middle = exposed.mean((1, 2, 3), keepdim=True)
    noise = torch.randn(images.shape, generator=generator) * 0.02
    return (middle + (exposed - middle) * factors(0.3) + noise).clamp(0, 1)


def _zoom(images: Tensor, targets: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Each image seen wider or narrower and moved; what comes from outside is void."""
    drawn = (torch.rand(3, len(images), generator=generator) * 2 - 1) * ZOOM
    scale = drawn[0].exp()
    zero = torch.zeros_like(scale)
    rows = (torch.stack([scale, zero, drawn[1]], 1), torch.stack([zero, scale, drawn[2]], 1))
    view = F.affine_grid(torch.stack(rows, 1), list(images.shape), align_corners=False)
    moved = F.grid_sample(images, view, padding_mode="reflection", align_corners=False)
    ids = (targets[:, None] - VOID).float()
    sampled = F.grid_sample(ids, view, mode="nearest", align_corners=False)
    return moved, sampled[:, 0].long() + VOID
