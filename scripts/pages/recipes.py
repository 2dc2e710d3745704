#!/usr/bin/env python3
"""Writes docs/recipes.md: what settings of a network cost that docs/guides/own-network.md names.

    .venv/bin/python scripts/pages/recipes.py --data ../shared/data

The networks of the folder `networks` run in ONNX Runtime and in OpenVINO in turn. ESPNetv2 labels
every fourth picture of a drive of CamVid with right and wrong preparations, and two real pairs of
traverses with a background channel. It wins where no class has a probability of one half, as in a
network that says background where it is unsure. About six minutes on one thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from _described import ALONE
from _markdown import Page, head_row, interval, parser, processor, row
from conditions import NETWORKS, REAL
from torch import Tensor

from ssrvlad_torch import SSRVLAD, Segmenter
from ssrvlad_torch.datasets.image_files import decode_image
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.recognition.comparison import Member, ReferenceRows
from ssrvlad_torch.recognition.recognise import Steps, recognise
from ssrvlad_torch.segmentation.network_outputs import classes_of, enlarged
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_network import RUNTIMES, OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmented
from ssrvlad_torch.taxonomy import NO_LAYER, label_space

SPACE, CLASSES, VOID, LEAST = "cityscapes-trainids", 19, 255, 0.5
EVERY, PICTURES = 4, 30
WRONG = {
    "as the network was trained": {},
    "BGR for RGB": {"colour_order": "bgr"},
    "0 to 255 for 0 to 1": {"white": 255.0},
    "no mean and deviation": {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)},
    "half the size": {"size": (288, 384)},
}
PAIRS = (("UofA", "evening -> day"), ("Gardens Point", "right -> left"))


def runtimes(data: Path) -> Iterator[str]:
    """A table: OpenVINO against ONNX Runtime, on one picture after another in turn."""
    others = ("pixels with another label", "other signs", "other first answers")
    yield from head_row("network", "times as fast", *others)
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    for name in NETWORKS:
        config = open_network(data / "networks" / f"{name}.yaml").config
        graph = data / "networks" / f"{name}_city.onnx"
        both = [Segmenter(OnnxNetwork(graph, runtime), SPACE, config) for runtime in RUNTIMES]
        known = [both[0].segment([each], features=True)[0] for each in pictures(data, "day")]
        seen: tuple[list[Segmented], list[Segmented]] = ([], [])
        times = np.zeros((2, PICTURES))
        for number, picture in enumerate(pictures(data, "evening")):
            for way in (0, 1) if number % 2 else (1, 0):
                begin = time.process_time()
                seen[way].extend(both[way].segment([picture], features=True))
                times[way, number] = time.process_time() - begin
        pairs = list(zip(*seen, strict=True))
        faster = np.quantile(times[0, 1:] / times[1, 1:], (0.5, 0.05, 0.95))
        labels = np.mean([np.mean(a.labels != b.labels) for a, b in pairs])
        signs = np.mean([np.unpackbits(a.features ^ b.features).mean() for a, b in pairs])
        first = [first_answers(each, known, head) for each in seen]
        changed = int((first[0] != first[1]).sum())
        counts = f"{changed} of {len(first[0])}"
        yield row(name, interval(faster[0], faster[1:], 2), f"{labels:.1e}", f"{signs:.1e}", counts)


def pictures(data: Path, part: str) -> list[np.ndarray]:
    """Some pictures of a traverse of UofA."""
    files = sorted((data / "uofa" / part / "images").iterdir())
    chosen = files[:: len(files) // PICTURES][:PICTURES]
    return [decode_image(file.read_bytes()) for file in chosen]


def first_answers(seen: list[Segmented], known: list[Segmented], head: SSRVLAD) -> Tensor:
    """The first answers of queries by label maps, then by features, each alone."""
    shapes, signs = [], []
    for said in (seen, known):
        shapes.append(torch.cat([head(torch.from_numpy(each.labels)[None]) for each in said]))
        signs.append(torch.from_numpy(np.stack([each.features for each in said])))
    by_signs = ReferenceRows(signs[1], [""] * len(known)).compare(signs[0], False, True).whole()
    return torch.cat(((shapes[0] @ shapes[1].T).argmax(1), by_signs.argmax(1)))


def preparations(settings: Path, camvid: Path) -> Iterator[str]:
    """A table: the fraction of pixels in the right category, by preparation."""
    right = Segmenter.load(settings, SPACE)
    truth = find_label_files([str(camvid / "labels")])[::EVERY]
    yield from head_row("preparation", "right")
    for name, changes in WRONG.items():
        wrong = Segmenter(right.network, SPACE, replace(right.config, **changes))
        counts = np.zeros(2, np.int64)
        for file in truth:
            known = categories(read_label_map(file, label_space("camvid-11")), "camvid-11")
            picture = next((camvid / "images").glob(f"{file.name}.*"))
            (seen,) = wrong([decode_image(picture.read_bytes())])
            asked = known < NO_LAYER
            counts += [(categories(seen, SPACE) == known)[asked].sum(), asked.sum()]
        yield row(name, f"{counts[0] / counts[1]:.3f}")


def background(settings: Path, data: Path) -> Iterator[str]:
    """A table: RecallRate@1 with the channel as void, and with every pixel in a class."""
    segmenter = Segmenter.load(settings, SPACE)
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    ways = ("void", "classes", "void, all steps", "classes, all steps")
    yield from head_row("traverses", "pixels that it wins", *ways)
    for dataset, name in PAIRS:
        queries, references, rows = REAL[dataset][name]
        sides = [described(data / folder, segmenter, head) for folder in (queries, references)]
        (here, lost), (there, _) = sides
        near = abs(np.arange(len(here[0]))[:, None] - np.arange(len(there[0]))) <= rows
        rates = [
            rate(here[kind], there[kind], near, steps)
            for steps in (ALONE, Steps(sweep=False))
            for kind in (0, 1)
        ]
        yield row(f"{dataset}, {name}", f"{lost:.1%}", *(f"{rate:.2f}" for rate in rates))


def described(
    folder: Path, segmenter: Segmenter, head: SSRVLAD
) -> tuple[tuple[Tensor, Tensor], float]:
    """Descriptors of a traverse with the channel as void and without it, and what it wins."""
    found, won = (list[Tensor](), list[Tensor]()), list[float]()
    for picture in sorted((folder / "images").iterdir()):
        pixels = torch.from_numpy(decode_image(picture.read_bytes()))[None]
        scores = segmenter.labels.run(pixels)[0]
        background = scores.logsumexp(1, keepdim=True) + math.log(LEAST)
        for kind, channels in zip(found, (torch.cat((scores, background), 1), scores), strict=True):
            labels = enlarged(classes_of(channels), *pixels.shape[1:3])
            kind.append(head(torch.where(labels < CLASSES, labels, VOID)))
        won.append(float((scores.softmax(1).amax(1) < LEAST).float().mean()))
    return (torch.cat(found[0]), torch.cat(found[1])), float(np.mean(won))


def rate(here: Tensor, there: Tensor, near: np.ndarray, steps: Steps) -> float:
    """RecallRate@1."""
    alone = [str(n) for n in range(len(here))] if steps == ALONE else ["q"] * len(here)
    names = ["r"] * len(there)
    member = Member(here, ReferenceRows(there, names))
    first = recognise({"x": member}, alone, names, steps, 1).matches.indices[:, 0]
    return float(near[np.arange(len(here)), first.numpy()].mean())


def categories(labels: np.ndarray, name: str) -> np.ndarray:
    """The category of each pixel, `NO_LAYER` where it has none."""
    table = np.full(256, NO_LAYER, np.uint8)
    for entry in label_space(name).classes:
        table[entry.id % 256] = min(entry.category_index, NO_LAYER)
    return table[labels]


def main() -> None:
    options = parser(__doc__, "recipes.md").parse_args()
    settings = options.data / "networks" / "espnetv2.yaml"
    page = Page("recipes.md", options.output)
    page.paragraph("Measured on", f"Measured on {processor()}.")
    page.table("## ONNX Runtime or OpenVINO\n", runtimes(options.data))
    page.table("## The preparation\n", preparations(settings, options.data / "camvid" / "0001TP"))
    page.table("## A background channel\n", background(settings, options.data))


if __name__ == "__main__":
    main()
