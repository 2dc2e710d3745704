"""Drives of images and label maps in memory, and the batches that a network is trained on.

A batch follows from its number alone, whatever was drawn before it, so that a run that was
killed goes on as if it had not been.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import kornia.augmentation as K
import numpy as np
import torch
from kornia.constants import DataKey, Resample, SamplePadding
from kornia.enhance import normalize
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
    """A batch of random frames, some mirrored, in changed light, and zoomed on request."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(number)
        rows = torch.randperm(len(drive.frames))[:count]
        images = drive.images[rows].permute(0, 3, 1, 2).float() / 255
        ids = (drive.targets[rows, None].long() - VOID).float()  # what comes from outside is void
        changed = augmentation(zoomed)
        images, ids = changed(images, ids)
    mirrored = changed._params[0].data["batch_prob"] > 0
    targets = ids[:, 0].round().long() + VOID
    return Batch(normalise(images.clamp(0, 1)), targets, rows, mirrored)


def augmentation(zoomed: bool) -> K.AugmentationSequential:
    """Augments images and their label maps: mirrors, zooms and moves both; changes colour, contrast
    and exposure of the images, and adds noise."""
    zoom = K.RandomAffine(
        0, (ZOOM / 2, ZOOM / 2), (1 - ZOOM, 1 + ZOOM), p=1, padding_mode="reflection"
    )
    light = (
        K.ColorJiggle(0.3, 0.3, 0.3, 0.02, p=1),
        K.RandomGamma((0.6, 1.7), (0.8, 1.2), p=1),
        K.RandomGaussianNoise(0, 0.02, p=1),
    )
    of_masks = {
        "resample": Resample.NEAREST,
        "padding_mode": SamplePadding.ZEROS,
        "align_corners": False,
    }
    return K.AugmentationSequential(
        K.RandomHorizontalFlip(p=0.5),
        *([zoom] if zoomed else []),
        *light,
        data_keys=["input", "mask"],
        extra_args={DataKey.MASK: of_masks},
    )


def normalise(images: Tensor) -> Tensor:
    """Normalises images from 0 to 1 for the network."""
    return normalize(images, torch.tensor(MEAN), torch.tensor(STD))
