"""The time of deciding where the queries of a sequence are, beside that of comparing them with a
map: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from statistics import median

import numpy as np
import torch
from _markdown import head_row, row

from ssrvlad_torch.recognition.recognise import Steps, recognise_by_scores, references_of
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.stages.features import SHAPE

FRAMES, QUERIES, LENGTH, NOISE = 10_000, 150, 480, 0.1
SEEN = slice(FRAMES // 3, FRAMES // 3 + QUERIES)
Arrays = Mapping[str, np.ndarray]


def sequences_table(repetitions: int) -> Iterator[str]:
    """A row for label maps from one column, for the full sweep, and with features and HOG."""
    names = ("comparing", "deciding, single frames", "deciding, offline")
    yield from head_row("channels", *names, "offline / comparing")
    for title, (frames, queries) in drawn().items():
        sweep = queries["label_shapes"].shape[1] > 1
        places, sequences = ["map"] * FRAMES, ["queries"] * QUERIES
        town = references_of(frames, places)
        times: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(repetitions):
            began = time.process_time()
            scores = torch.from_numpy(town.compare(queries, True, sweep)[0])
            times["comparing"].append(time.process_time() - began)
            for name, follow in zip(names[1:], (None, "offline"), strict=True):
                began = time.process_time()
                recognise_by_scores(scores, sequences, places, Steps(follow=follow))
                times[name].append(time.process_time() - began)
        pairs = zip(times["deciding, offline"], times["comparing"], strict=True)
        ratio = median(offline / comparing for offline, comparing in pairs)
        yield row(title, *(f"{1e3 * median(times[name]):.0f}" for name in names), f"{ratio:.2f}")


def drawn() -> dict[str, tuple[Arrays, Arrays]]:
    """Made-up frames of a map, of which neighbours are alike, and queries along it with noise."""
    rng = np.random.default_rng(0)

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    def vectors() -> np.ndarray:
        noise = rng.standard_normal((FRAMES + 3, LENGTH), np.float32)
        return unit(sum(noise[first : FRAMES + first] for first in range(4)))

    def seen(frames: np.ndarray, columns: int) -> np.ndarray:
        noise = rng.standard_normal((QUERIES, columns, LENGTH), np.float32)
        return unit(frames[SEEN, None] + NOISE * noise)

    labels, hog = vectors(), vectors()
    signs = rng.integers(0, 256, (FRAMES, *SHAPE), np.uint8)
    others = np.bitwise_and.reduce(rng.integers(0, 256, (3, QUERIES, *SHAPE), np.uint8))
    width = len(COLUMNS)
    frames = {"label_shapes": labels, "features": signs, "hog": hog}
    queries = {"features": signs[SEEN] ^ others, "hog": seen(hog, width)}
    alone = {"label_shapes": labels}
    return {
        "label maps, one column": (alone, {"label_shapes": seen(labels, 1)}),
        "label maps, swept": (alone, {"label_shapes": seen(labels, width)}),
        "label maps, features and HOG": (frames, {"label_shapes": seen(labels, width), **queries}),
    }
