"""The time from a picture to its descriptors: file, network, head, features and HOG."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from _markdown import head_row, row, span
from _timing import Timing, time_in_turn

from ssrvlad_torch import SSRVLAD, Segmenter
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.datasets.image_files import decode_image
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.segmentation.network_outputs import classes_of, enlarged, scores_along
from ssrvlad_torch.segmentation.onnx_files import open_session
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork

PARTS = ("decoded", "prepared", "network", "class and size", "head", "features", "HOG")
PICTURES = 8


def pictures_table(networks: Path, pictures: list[Path], repetitions: int) -> Iterator[str]:
    """A row for every YAML file in a folder whose network gives trainIds."""
    pictures = pictures[:: len(pictures) // PICTURES][:PICTURES]
    yield from head_row(
        "network", "size", "whole", *PARTS, "features / network", "fused file, without decoding"
    )
    for settings in sorted(networks.glob("*.yaml")):
        segmenter = Segmenter.load(settings, "cityscapes-trainids")
        head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "place.onnx"
            fuse(segmenter, head.config, file)
            session = open_session(file, file, threads=1)
            decoded = [decode_image(picture.read_bytes())[None] for picture in pictures]
            run = partial(_run_all, session, decoded)
            fused = time_in_turn({"fused": run}, repetitions)["fused"]
        taken = np.array([_parts(segmenter, head, pictures) for _ in range(repetitions + 1)])[1:]
        parts = np.median(taken, 0) / len(pictures) * 1e3
        whole = Timing(tuple((taken.sum(1) / len(pictures)).tolist())).milliseconds
        size = segmenter.config.size
        assert isinstance(size, tuple)
        yield row(
            settings.stem,
            f"{size[0]} x {size[1]}",
            span(whole, 0),
            *(f"{part:.1f} ({part / parts.sum():.1%})" for part in parts),
            f"{parts[PARTS.index('features')] / parts[PARTS.index('network')]:.2%}",
            f"{fused.milliseconds['median'] / len(pictures):.0f}",
        )


def _run_all(session: object, images: list[np.ndarray]) -> None:
    for image in images:
        session.run(["descriptor"], {"image": image})


def _parts(segmenter: Segmenter, head: SSRVLAD, pictures: list[Path]) -> list[float]:
    """Seconds of each of `PARTS`, of all pictures."""
    labels, network = segmenter.labels, segmenter.network
    assert isinstance(network, OnnxNetwork)
    features, hog = segmenter.features, HOG()
    taken = [0.0] * len(PARTS)
    for picture in pictures:
        marks = [time.perf_counter()]
        pixels = np.array(decode_image(picture.read_bytes()))
        marks.append(time.perf_counter())
        numbers = labels.preparation(torch.from_numpy(pixels)[None])
        marks.append(time.perf_counter())
        result = network(numbers, names=[labels.output, *features.names])
        marks.append(time.perf_counter())
        scores = scores_along(result[labels.output], labels.axis, labels.config.classes)
        found = enlarged(classes_of(scores), *pixels.shape[:2])
        marks.append(time.perf_counter())
        head(found)
        marks.append(time.perf_counter())
        features([result[name] for name in features.names])
        marks.append(time.perf_counter())
        hog.describe([View("picture", picture=pixels)])
        marks.append(time.perf_counter())
        taken = [sum(pair) for pair in zip(taken, np.diff(marks).tolist(), strict=True)]
    return taken
