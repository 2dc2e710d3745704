"""A third design of a segmentation network, trained here: plain convolutions at strides 2 to 16,
and class scores at stride 8. Some minutes on one thread; its weights are cached."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from _described import Described
from conditions import Drive, camvid, kept
from torch import Tensor, nn

from ssrvlad_torch.datasets.image_files import decode_image
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter

NAME = "trained here"
WIDTHS, CLASSES = (24, 48, 96, 128), 11
STEPS, BATCH, CROP, RATE = 1200, 4, (224, 320), 3e-3
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class SmallNetwork(nn.Module):
    """Class scores ``(B, 11, H / 8, W / 8)`` of pictures ``(B, 3, H, W)``, multiples of 16."""

    def __init__(self) -> None:
        super().__init__()
        befores = (3, *WIDTHS)
        stages = [
            nn.Sequential(block(before, width, 2), block(width, width, 1))
            for before, width in zip(befores, WIDTHS, strict=False)
        ]
        self.finer, self.coarsest = nn.Sequential(*stages[:-1]), stages[-1]
        self.of_finer, self.of_coarsest = (nn.Conv2d(w, CLASSES, 1) for w in WIDTHS[-2:])

    def forward(self, pictures: Tensor) -> Tensor:
        finer = self.finer(pictures)
        coarsest = self.of_coarsest(self.coarsest(finer))
        enlarged = F.interpolate(coarsest, scale_factor=2.0, mode="bilinear")
        scores: Tensor = self.of_finer(finer) + enlarged
        return scores


def block(before: int, width: int, stride: int) -> nn.Sequential:
    convolution = nn.Conv2d(before, width, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(width), nn.ReLU())


def segmenter(described: Described) -> Segmenter:
    """The network, trained on the label maps of CamVid, as a segmenter."""
    network, file = SmallNetwork(), described.cache / "small network.pt"
    network.load_state_dict(kept(file, lambda: trained(described.data / "camvid")))
    size = described.shorter_side
    config = SegmenterConfig(
        size=size, multiple=16, mean=MEAN, std=STD, white=1, colour_order="rgb"
    )
    return Segmenter(network.eval(), "camvid-11", config)


def trained(folder: Path) -> dict[str, Tensor]:
    """The state of a network after some steps on crops of labelled frames."""
    torch.manual_seed(0)
    network = SmallNetwork().train()
    optimizer = torch.optim.AdamW(network.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, STEPS)
    for step, (pictures, labels) in enumerate(crops(camvid(folder, "labels")), 1):
        scores = F.interpolate(network(pictures), scale_factor=8.0, mode="bilinear")
        loss = F.cross_entropy(scores, labels, ignore_index=255)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            known = labels != 255
            right = (scores.argmax(1) == labels)[known].float().mean()
            print(f"step {step}: {float(right):.2f} of the pixels right", flush=True)
    return network.state_dict()


def crops(drive: Drive) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of crops of frames, half of them mirrored: pictures ``(B, 3, H, W)`` as the network
    takes them, labels ``(B, H, W)`` with 255 for void."""
    rng, (height, width) = np.random.default_rng(0), CROP
    mean, std = (torch.tensor(each).view(3, 1, 1) for each in (MEAN, STD))
    for _ in range(STEPS):
        pictures, labels = [], []
        for number in rng.integers(0, len(drive.frames), BATCH):
            pixels = decode_image(drive.pictures[number].read_bytes())
            top, left = (
                int(rng.integers(0, side - part + 1))
                for side, part in zip(pixels.shape[:2], CROP, strict=True)
            )
            window = slice(top, top + height), slice(left, left + width)
            picture = (torch.tensor(pixels[window]).permute(2, 0, 1) / 255 - mean) / std
            label = torch.tensor(drive.maps[number][window]).long()
            if rng.random() < 0.5:
                picture, label = picture.flip(2), label.flip(1)
            pictures.append(picture)
            labels.append(label.where(label < CLASSES, 255))
        yield torch.stack(pictures), torch.stack(labels)
