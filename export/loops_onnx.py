#!/usr/bin/env python3
"""Loop closures in a live stream with an exported or fused file: images in, loops out.

python export/loops_onnx.py place.onnx images/monday
camera | python export/loops_onnx.py place.onnx -

Prints a JSON object a line for every frame, as `ssrvlad loops --json` does: `frame`, `reason`,
`candidate`, `score`, `probability`, `ahead`. `-` reads names of files on stdin, one a line, and
answers each at once. Needs numpy, onnxruntime and `run_onnx.py` beside it, which lists the formats
of frames. The rules and thresholds are those of `ssrvlad_torch.LoopDetector`; with one anchor a
frame, those of `ssrvlad loops --no-sweep`. Exit code 0 for success, 2 for wrong use, 3 for finished
with some frames skipped.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from run_onnx import SOME_SKIPPED, add_model, find_frames, note, one_line, open_model

Vector = npt.NDArray[np.float32]

BLOCK_ROWS = 1024
"""Rows of a block of the map."""
STDIN = Path("-")

SPEEDS: tuple[tuple[float, dict[int, float]], ...] = (
    (0.08, {-1: 0.05, 0: 0.9, 1: 0.05}),
    (0.16, {0: 0.5, 1: 0.5}),
    (0.34, {0: 0.1, 1: 0.8, 2: 0.1}),
    (0.16, {1: 0.5, 2: 0.5}),
    (0.14, {1: 0.1, 2: 0.8, 3: 0.1}),
    (0.07, {2: 0.1, 3: 0.8, 4: 0.1}),
    (0.05, {3: 0.15, 4: 0.7, 5: 0.15}),
)
"""Probability of each speed along the map, and of its steps in rows."""
GAP = 5
"""The longest step in rows, and the number of empty cells between two sequences."""
WAYS = (1, -1)
"""The rows are run forwards and, as a decoy, backwards: what that holds is chance."""
CHANGE, JUMP, UNMAPPED, STAY = 0.01, 0.01, 0.3, 0.97
"""Probabilities: a changed speed, a jump, a jump to a new place, and to stay at new places."""
WEIGHT, LEVEL, MAX_LOG = 0.25, 0.5, 50.0
"""The likelihood of a row of z-score z is exp(WEIGHT * (z - LEVEL)), and at most exp(MAX_LOG)."""
EVIDENCE, LEVEL_FRACTION, NEIGHBOURS = 3.0, 0.9, 1000
"""For rows of the same sequence: what twice the level counts; and the level, as a fraction of the
z-score that three quarters of the last frames have with their previous frame."""
STRIDE = 50
"""The previous frame is one frame before where 50 are excluded, and two where 100 are."""
NEAR, RECENT = 5, 10
"""Rows on each side of a row that show its place, and the least age of the present place."""

MARGIN, APART, TRACK = 1.2, 5, 15
"""A row counts as seen again where it is so much nearer than different places of its street are:
excluded frames that are a fifth of them apart, or more, by the mean over so many frames."""

BEFORE = 10
"""How many frames the mean of all earlier sequences counts in that of a sequence."""

_MIN_SPREAD = _ROUNDING = 1e-6
_MIN_LENGTH = 1e-9**0.5


class Settings(NamedTuple):
    """The settings of the detector, as in `ssrvlad_torch.LoopConfig`: the last `exclude` frames are
    no candidates, and a loop has at least the probability `threshold`.
    """

    exclude: int = 50
    threshold: float = 0.8


class Loop(NamedTuple):
    """The result of a frame, see `ssrvlad_torch.loops.result.LoopResult`; without poses, `ahead` is
    always `None`."""

    frame: str
    reason: str
    candidate: str | None = None
    score: float | None = None
    probability: float | None = None
    ahead: float | None = None


class Map:
    """Descriptors of the frames so far; each sequence has its own mean, the present one that of its
    frames so far."""

    def __init__(self) -> None:
        self.rows = 0
        self.empty = np.empty(0, np.bool_)
        self._blocks: list[Vector] = []
        self._total, self._before = np.zeros(1), np.zeros(1)
        self._counted = self._counted_before = 0
        self._means, self._frames = list[Vector](), list[int]()
        self._lengths = np.empty(0, np.float32)

    def append(self, descriptor: Vector) -> None:
        """Appends the next frame of the stream."""
        block, place = divmod(self.rows, BLOCK_ROWS)
        if place == 0:
            self._blocks.append(np.zeros((BLOCK_ROWS, len(descriptor)), np.float32))
        self._blocks[block][place] = descriptor
        self._total, self._counted = self._total + descriptor, self._counted + descriptor.any()
        self.empty = np.append(self.empty, not descriptor.any())
        self.rows += 1

    def start_sequence(self) -> None:
        """The next frame starts another sequence: the mean of the present one stays as it is."""
        first = len(self._lengths)
        if first == self.rows:
            return
        mean = self._mean(np.zeros(1), 0)
        blocks = [
            np.linalg.norm(block - mean, axis=1) for block in self._blocks[first // BLOCK_ROWS :]
        ]
        skip = first % BLOCK_ROWS
        fresh = np.concatenate(blocks)[skip : skip + self.rows - first]
        self._lengths = np.append(self._lengths, np.maximum(fresh, np.float32(_MIN_LENGTH)))
        self._means.append(mean)
        self._frames.append(self.rows - first)
        self._before = self._before + self._total
        self._counted_before += self._counted
        self._total, self._counted = np.zeros(1), 0

    def _mean(self, descriptor: Vector, counted: int) -> Vector:
        """``(D,)``, the mean of the present sequence with another frame."""
        total, counted = self._total + descriptor, self._counted + counted
        if self._counted_before:
            total, counted = (
                total + self._before * (BEFORE / self._counted_before),
                counted + BEFORE,
            )
        mean: Vector = (total / max(1, counted)).astype(np.float32)
        return mean

    def scores(self, swept: Vector) -> Vector:
        """``(rows,)`` cosines of a new frame's best anchor, each frame without the mean of its
        sequence; -inf for an empty frame."""
        mean, first = self._mean(swept[len(swept) // 2], 1), len(self._lengths)
        centred = swept - mean
        centred[np.abs(centred).max(axis=1) <= _ROUNDING] = 0
        centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), _ROUNDING)
        columns = np.concatenate((centred, mean[None]))
        products = np.concatenate([columns @ block.T for block in self._blocks], axis=1)
        products = products[:, : self.rows]
        square = 1 - 2 * products[-1, first:] + mean @ mean
        lengths = np.append(self._lengths, np.sqrt(np.maximum(square, _MIN_LENGTH**2)))
        offsets = centred @ np.stack([*self._means, mean]).T
        products = products[:-1] - np.repeat(offsets, [*self._frames, self.rows - first], axis=1)
        scores: Vector = (products.max(axis=0) / lengths).astype(np.float32)
        scores[self.empty] = -np.inf
        return scores


class Filter:
    """A hidden Markov model over the rows of the map, the same rows run backwards, and a new place.

    Cells are the rows in their order, with empty cells between sequences, so that no step leads
    from one sequence into the next.
    """

    def __init__(self) -> None:
        self.cells = np.empty(0, np.int64)
        self.inside = np.zeros(GAP, np.float32)
        self.mapped = np.zeros((len(WAYS), len(SPEEDS), GAP), np.float32)
        self.unmapped = 1.0
        prior = np.array([probability for probability, _ in SPEEDS], np.float32)[:, None]
        self._prior = np.stack([prior / len(WAYS)] * len(WAYS))
        self._starting = True

    def extend(self, starts_sequence: bool) -> None:
        """Appends a row."""
        fresh = np.full(1 + GAP, 0, np.float32)
        if not starts_sequence:
            fresh = fresh[:1]
        self.inside = np.concatenate((self.inside, fresh))
        self.cells = np.append(self.cells, len(self.inside) - 1 - GAP)
        self.inside[self.cells[-1]] = 1
        more = np.zeros((len(WAYS), len(SPEEDS), len(fresh)), np.float32)
        self.mapped = np.concatenate((self.mapped, more), axis=2)

    def restart(self) -> None:
        """Forgets the place: the next frame starts another sequence."""
        self.unmapped = UNMAPPED if len(self.cells) else 1.0
        each = (1 - self.unmapped) / max(1, len(self.cells))
        self.mapped = self._prior * (self.inside * np.float32(each))
        self._starting = True

    def step(self, log_likelihood: Vector) -> Vector:
        """The probability of each row ``(rows,)`` after the next frame.

        Args:
            log_likelihood: ``(rows,)``, of the frame, -inf where there can be no match.
        """
        if not self._starting:
            self._move()
        self._starting = False
        likelihood = np.zeros_like(self.inside)
        likelihood[self.cells] = np.exp(np.minimum(log_likelihood, MAX_LOG))
        mapped = self.mapped * likelihood
        total = float(mapped.sum()) + self.unmapped
        self.mapped, self.unmapped = mapped / np.float32(total), self.unmapped / total
        rows: Vector = self.mapped[0].sum(axis=0)[self.cells]
        return rows

    def _move(self) -> None:
        """Predicts the place of the next frame."""
        if not len(self.cells):
            return
        totals = self.mapped.sum(axis=1, keepdims=True) * len(WAYS)
        mixed = self.mapped * (1 - CHANGE) + CHANGE * self._prior * totals
        moved = np.zeros_like(mixed)
        end = mixed.shape[2] - GAP
        for number, way in enumerate(WAYS):
            for speed, (_, steps) in enumerate(SPEEDS):
                for step, probability in steps.items():
                    part = mixed[number, speed, GAP - way * step : end - way * step]
                    moved[number, speed, GAP:end] += np.float32(probability * (1 - JUMP)) * part
        moved *= self.inside
        lost = max(0.0, 1 - self.unmapped - float(moved.sum()))
        arriving = lost * (1 - UNMAPPED) + self.unmapped * (1 - STAY)
        moved += self._prior * (self.inside * np.float32(arriving / len(self.cells)))
        self.mapped, self.unmapped = moved, lost * UNMAPPED + self.unmapped * STAY


class Repeats:
    """For each frame of a sequence, the highest nearness of the frames around it to others of the
    same street, see `ssrvlad_torch.loops.repeats`."""

    def __init__(self, exclude: int) -> None:
        self._distances = np.arange(max(1, exclude // APART), exclude + 1)
        self._last: list[Vector] = []
        self._highest = np.empty(0, np.float32)

    def after(self, near: Vector) -> Vector:
        """``(N,)``, by the nearness ``(N,)`` of the next frame to all earlier ones."""
        more = len(near) + 1 - len(self._highest)
        self._highest = np.append(self._highest, np.full(more, -np.inf, np.float32))
        rows = len(near) - self._distances
        rows = rows[rows >= 0]
        seen = np.full(len(self._distances) + 2, -np.inf, np.float32)
        seen[1 : len(rows) + 1] = near[rows]
        widest = np.maximum(np.maximum(seen[:-2], seen[1:-1]), seen[2:])
        self._last = [*self._last, widest][-TRACK:]
        if len(self._last) == TRACK and len(rows):
            track, highest = np.mean(self._last, axis=0), self._highest
            highest[-TRACK:] = np.maximum(highest[-TRACK:], track.max())
            for age in range(TRACK):
                here = rows[rows >= age] - age
                highest[here] = np.maximum(highest[here], track[: len(here)])
        earlier: Vector = self._highest[:-1]
        return earlier


class Detector:
    """Decides for each frame of a stream whether its place was seen before."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.map, self.filter = Map(), Filter()
        self.start, self.neighbours = 0, list[float]()
        self.frames: list[str] = []

    def update(self, frame: str, descriptor: Vector) -> Loop:
        """Looks for the place of the next frame among the earlier frames, then stores it.

        Args:
            frame: its id, ``<sequence>/<name>``.
            descriptor: ``(D,)`` of length 1, or zero for an empty frame; or ``(S, D)`` from S
                anchors with the usual one in the middle.
        """
        swept = np.atleast_2d(descriptor)
        if not self.frames or _sequence(frame) != _sequence(self.frames[-1]):
            self.filter.restart()
            self.map.start_sequence()
            self.start, self.neighbours = len(self.frames), []
            self.repeats = Repeats(self.settings.exclude)
        result = self._step(frame, swept)
        self.frames.append(frame)
        self.map.append(swept[len(swept) // 2])
        return result

    def _step(self, frame: str, swept: Vector) -> Loop:
        exclude = self.settings.exclude
        old = max(0, len(self.frames) - exclude)
        for row in range(len(self.filter.cells), len(self.frames) - min(RECENT, exclude)):
            before = self.frames[row - 1] if row else ""
            self.filter.extend(not row or _sequence(self.frames[row]) != _sequence(before))
        empty, described = not swept[len(swept) // 2].any(), ~self.map.empty
        too_few = np.count_nonzero(described[:old]) < 2
        if too_few and not described.any():
            return Loop(frame, "empty_frame" if empty else "no_candidate")
        if empty:
            if not too_few:
                self.filter.step(np.zeros(len(self.filter.cells), np.float32))
            return Loop(frame, "empty_frame")
        scores = self.map.scores(swept)
        nearness = -np.log(np.maximum(1 - scores, np.float32(_ROUNDING)))
        nearness[~described] = -np.inf
        repeats = self.repeats.after(nearness[self.start :])
        if too_few:
            return Loop(frame, "too_recent")
        candidates = nearness[:old][described[:old]]
        mean, spread = candidates.mean(), max(_MIN_SPREAD, float(candidates.std()))
        likelihood = np.zeros_like(nearness)
        if spread > _MIN_SPREAD:
            z, repeats = (nearness - mean) / spread, (repeats - mean) / spread
            likelihood = self._log_likelihood(z, repeats)
        rows = self.filter.step(likelihood[: len(self.filter.cells)])
        candidate = int(rows[:old].argmax())
        around = rows[:old][max(0, candidate - NEAR) : candidate + NEAR + 1]
        probability = min(1.0, float(around.sum()))
        reason = self._reason(probability, float(rows[:old].sum()), float(rows[old:].sum()))
        return Loop(frame, reason, self.frames[candidate], float(scores[candidate]), probability)

    def _log_likelihood(self, z: Vector, repeats: Vector) -> Vector:
        """``(rows,)``, of a frame by its z-scores with all earlier frames, and by those that
        different places of the streets of this sequence have."""
        previous = len(z) - max(1, self.settings.exclude // STRIDE)
        if self.start <= previous and np.isfinite(z[previous]):
            self.neighbours.append(float(z[previous]))
        quartile = np.quantile(self.neighbours[-NEIGHBOURS:], 0.25) if self.neighbours else 0.0
        level = max(LEVEL, LEVEL_FRACTION * quartile, math.sqrt(2 * math.log(max(2, len(z)))))
        log_likelihood = np.float32(WEIGHT) * (z - np.float32(LEVEL))
        same = np.minimum(np.float32(EVIDENCE) * (z[self.start :] / level - 1), MAX_LOG)
        doubt = EVIDENCE * np.maximum(MARGIN * repeats / level - 1, 0).astype(np.float32)
        old = max(0, len(same) - self.settings.exclude)
        same[:old] -= doubt[:old]
        log_likelihood[self.start :] = same
        return log_likelihood

    def _reason(self, probability: float, old: float, recent: float) -> str:
        threshold = self.settings.threshold
        if probability >= threshold:
            return "accepted"
        if recent > max(old, 1 - old - recent):
            return "too_recent"
        return "ambiguous" if old >= threshold else "below_threshold"


def _sequence(frame: str) -> str:
    return frame.rpartition("/")[0]


def frames_of(sources: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Ids and files of the frames of folders, or of the names on stdin.

    Raises:
        ValueError: a source does not exist or holds no frame.
    """
    if list(sources) != [STDIN]:
        yield from find_frames(sources)
        return
    for line in map(os.fsdecode, sys.stdin.buffer):
        if line.strip():
            path = Path(line.rstrip("\r\n"))
            yield f"{path.absolute().parent.name}/{path.stem}", path


def run(options: argparse.Namespace) -> int:
    """Runs the detector over a stream; the exit code."""
    model = open_model(options)
    detector = Detector(Settings(options.exclude, options.threshold))
    done: set[str] = set()
    skipped = 0
    for frame, path in frames_of(options.source):
        try:
            if frame in done:
                raise ValueError(f"frame {frame} was there before")
            descriptor = model.describe(path)
        except ValueError as error:
            note(f"{path}: {one_line(error)}")
            skipped += 1
            continue
        done.add(frame)
        result = detector.update(frame, descriptor)
        print(json.dumps(result._asdict()), flush=True)
    if skipped:
        note(f"skipped {skipped} of {skipped + len(done)} frames")
    return SOME_SKIPPED if skipped else 0


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    defaults: dict[str, Any] = Settings()._asdict()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("source", type=Path, nargs="+", help="files or folders of frames, or -")
    parser.add_argument("--exclude", type=int, default=defaults["exclude"])
    parser.add_argument("--threshold", type=float, default=defaults["threshold"])
    return parser


def main() -> int:
    """The command line; errors are one line."""
    parser = arguments()
    options = parser.parse_args()
    alone = STDIN not in options.source or len(options.source) == 1
    if options.exclude < 0 or not 0 <= options.threshold <= 1 or not alone:
        parser.error("expected --exclude from 0, --threshold from 0 to 1, and - alone")
    try:
        return run(options)
    except (ValueError, OSError, ImportError) as error:
        note(f"loops_onnx: {one_line(error)}")
        return 2


if __name__ == "__main__":
    sys.exit(main())
