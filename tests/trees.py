"""Small data sets on disk in the layouts in which they are published; shared by the tests."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from helpers import write_image
from PIL import ExifTags, Image

from ssrvlad_torch.datasets.dataset import Dataset


def plant(root: Path, *names: str) -> Path:
    """Tiny images of the formats that their names say; the folders are made."""
    for name in names:
        write_image(root / name, np.zeros((4, 6, 3), np.uint8))
    return root


def write_placed(
    path: Path, latitude: tuple[float, ...], longitude: tuple[float, ...], status: str = "A"
) -> None:
    """A picture with its place, degrees, minutes and seconds, in EXIF tags; it looks north. Status
    V is a void position."""
    tag, exif = ExifTags.GPS, Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({
        tag.GPSLatitudeRef: "N", tag.GPSLatitude: latitude,
        tag.GPSLongitudeRef: "E", tag.GPSLongitude: longitude,
        tag.GPSStatus: status, tag.GPSImgDirectionRef: "T", tag.GPSImgDirection: 0.0,
    })  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def write(path: Path, lines: Iterable[str] | str) -> Path:
    """A text file; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(lines if isinstance(lines, str) else "".join(f"{line}\n" for line in lines))
    return path


def outline(dataset: Dataset) -> dict[str, list[str]]:
    """Names of the frames by sequence, in order."""
    return {
        sequence: [frame.name for frame in dataset.frames if frame.sequence == sequence]
        for sequence in dataset.sequences
    }


def roles(dataset: Dataset) -> dict[str, str | None]:
    """Roles by sequence."""
    return {frame.sequence: frame.role for frame in dataset.frames}
