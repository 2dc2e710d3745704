#!/usr/bin/env python3
"""Loop closures in a live stream with an exported or fused file: images in, loops out.

python export/loops_onnx.py place.onnx images/monday
camera | python export/loops_onnx.py place.onnx -

Prints a JSON object a line for every frame, as `ssrvlad loops --json` does: `frame`, `reason`,
`candidate`, `score`, `strength`. `-` takes names of files on stdin, one a line, each as soon as it
is there. Needs numpy, onnxruntime and `run_onnx.py` beside it, which says what a frame can be; the
rules are those of `ssrvlad_torch.LoopDetector`, whose thresholds hold here too. Exit code 0 for
success, 2 for wrong use, 3 for finished with some frames refused.
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
from run_onnx import SOME_REFUSED, Model, find_frames, note, one_line

Vector = npt.NDArray[np.float32]

BLOCK_ROWS = 1024
"""Rows of the map that are made room for at once."""
STDIN = Path("-")

_LEAST_SPREAD = _ROUNDING = 1e-6


class Settings(NamedTuple):
    """The settings of the detector, which are those of `ssrvlad_torch.LoopConfig`.

    The last `exclude` frames are no candidates. A frame of the map is the sum of `temporal` frames
    on each side. The mean strength of the last `confirmations` best candidates must reach
    `threshold`; it is a cosine, or if `relative` by how many standard deviations the candidate is
    nearer than all are. A rival of another place must be so much farther away that the ratio of
    the distances is at most `ratio`. Frames at most `neighbourhood` apart show one place. The last
    `confirmations` candidates must follow each other by at most `window` frames.
    """

    exclude: int = 50
    temporal: int = 1
    threshold: float = 6.7
    relative: bool = True
    ratio: float = 0.9
    neighbourhood: int = 10
    confirmations: int = 3
    window: int = 3


class Loop(NamedTuple):
    """What became of a frame; the reasons are those of `ssrvlad_torch.loops.result.LoopResult`."""

    frame: str
    reason: str
    candidate: str | None = None
    score: float | None = None
    strength: float | None = None


class Map:
    """Descriptors of the frames so far, summed over time; it lags behind by `reach` frames."""

    def __init__(self, reach: int) -> None:
        self.reach = reach
        self.rows = 0
        self._blocks: list[Vector] = []
        self._empty: list[npt.NDArray[np.bool_]] = []
        self._window: list[Vector] = []
        self._waiting = 0

    def append(self, descriptor: Vector, starts_sequence: bool) -> None:
        """Adds the next frame of the stream."""
        if starts_sequence:
            while self._waiting:
                self._take_in()
            self._window.clear()
        self._window.append(descriptor)
        del self._window[: -2 * self.reach - 1]
        self._waiting += 1
        if self._waiting > self.reach:
            self._take_in()

    def scores(self, query: Vector) -> Vector:
        """``(rows,)`` cosines, -inf for an empty frame."""
        if not self.rows:
            return np.empty(0, np.float32)
        scores = np.concatenate([block @ query for block in self._blocks])
        scores[np.concatenate(self._empty)] = -np.inf
        return scores[: self.rows]

    def _take_in(self) -> None:
        """The oldest waiting frame, after Eq. 3."""
        here = len(self._window) - self._waiting
        near = self._window[max(0, here - self.reach) : here + self.reach + 1]
        total = np.sum(near, axis=0) * self._window[here].any()
        block, place = divmod(self.rows, BLOCK_ROWS)
        if place == 0:
            self._blocks.append(np.zeros((BLOCK_ROWS, len(total)), np.float32))
            self._empty.append(np.ones(BLOCK_ROWS, np.bool_))
        length = float(np.linalg.norm(total))
        self._blocks[block][place] = total / max(length, 1e-12)
        self._empty[block][place] = length == 0
        self.rows += 1
        self._waiting -= 1


class Detector:
    """Tells for each frame of a stream whether its place was seen before."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.map = Map(settings.temporal)
        self.frames: list[str] = []
        self._sequence_start = 0
        self._candidates: list[int] = []
        self._strengths: list[float] = []
        self._places: list[int] = []

    def update(self, frame: str, descriptor: Vector) -> Loop:
        """Looks for the place of the next frame among the earlier ones, then remembers it.

        Args:
            frame: its id, ``<sequence>/<name>``.
            descriptor: ``(D,)`` of length 1, or zero for an empty frame.
        """
        row = len(self.frames)
        starts = not row or frame.rpartition("/")[0] != self.frames[-1].rpartition("/")[0]
        self._sequence_start = row if starts else self._sequence_start
        self._candidates.append(-1)
        self._strengths.append(math.nan)
        self._places.append(row)
        result = self._find(frame, descriptor)
        self.frames.append(frame)
        self.map.append(descriptor, starts)
        if result.reason == "accepted":
            for shown in range(row + 1 - self.settings.confirmations, row + 1):
                self._places[shown] = self._places[self._candidates[shown]]
        return result

    def _find(self, frame: str, descriptor: Vector) -> Loop:
        if not descriptor.any():
            return Loop(frame, "empty_frame")
        if not self.frames:
            return Loop(frame, "no_candidate")
        scores = self.map.scores(descriptor / np.linalg.norm(descriptor))
        old = scores[: max(0, len(self.frames) - self.settings.exclude)]
        compared = old[old > -np.inf]
        if not len(compared):
            return Loop(frame, "no_candidate" if len(old) else "too_recent")
        candidate = int(old.argmax())
        own, cutoff = self._strength(scores[candidate], compared)
        self._candidates[-1], self._strengths[-1] = candidate, own
        strength = float(np.nanmean(self._strengths[-self.settings.confirmations :]))
        reason = self._reason(scores, candidate, strength, cutoff)
        return Loop(frame, reason, self.frames[candidate], float(scores[candidate]), strength)

    def _strength(self, score: np.float32, compared: Vector) -> tuple[float, float]:
        """Of a candidate, and the threshold as a cosine."""
        threshold = self.settings.threshold
        if not self.settings.relative:
            return float(score), threshold
        nearness = _nearness(compared).astype(np.float64)
        mean, spread = float(nearness.mean()), max(float(nearness.std()), _LEAST_SPREAD)
        own = (float(_nearness(score)) - mean) / spread
        return own, 1 - math.exp(-mean - threshold * spread)

    def _reason(self, scores: Vector, candidate: int, strength: float, cutoff: float) -> str:
        if strength < self.settings.threshold:
            return "below_threshold"
        present = self._present(scores, min(cutoff, float(scores[candidate])))
        if candidate >= present:
            return "too_recent"
        if self._has_rival(scores, candidate, present):
            return "ambiguous"
        last = self._candidates[-self.settings.confirmations :]
        started = len(self.frames) + 1 - self.settings.confirmations
        together = -1 not in last and bool((abs(np.diff(last)) <= self.settings.window).all())
        confirmed = together and started >= self._sequence_start
        return "accepted" if confirmed else "inconsistent"

    def _present(self, scores: Vector, cutoff: float) -> int:
        """First row of the place that has not been left since."""
        alike = np.append(np.flatnonzero(scores >= cutoff), len(self.frames))
        gaps = np.diff(alike) - 1
        left = np.flatnonzero(gaps > self.settings.neighbourhood + self.settings.temporal)
        return int(alike[left[-1] + 1 if len(left) else 0])

    def _has_rival(self, scores: Vector, candidate: int, present: int) -> bool:
        """Whether a frame that shows neither the candidate's place nor the present one is near."""
        if self.settings.ratio == 1:
            return False
        reach = self.settings.neighbourhood
        others = scores[: max(0, present - reach)].copy()
        apart = abs(np.array(self._places) - self._places[candidate])
        for visit in np.flatnonzero(apart <= reach).tolist():
            near = reach - int(apart[visit])
            others[max(0, visit - near) : visit + near + 1] = -np.inf
        rival = float(others.max(initial=-np.inf))
        return 1 - float(scores[candidate]) > self.settings.ratio**2 * (1 - rival)


def _nearness(scores: Vector | np.float32) -> Vector:
    """How near candidates are: less the logarithm of half their squared Euclidean distance."""
    return -np.log(np.maximum(1 - scores, np.float32(_ROUNDING)))


def frames_of(sources: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Ids and files of the frames, of folders or as their names come in on stdin.

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


def run(given: argparse.Namespace) -> int:
    """What the command line asks for; the exit code."""
    model = Model(given.model)
    relative = not given.absolute
    detector = Detector(Settings(given.exclude, given.temporal, given.threshold, relative))
    seen: set[str] = set()
    refused = 0
    for frame, path in frames_of(given.source):
        try:
            if frame in seen:
                raise ValueError(f"frame {frame} was there before")
            described = model.describe(path)
        except ValueError as error:
            note(f"{path}: {one_line(error)}")
            refused += 1
            continue
        seen.add(frame)
        result = detector.update(frame, described.descriptor)
        print(json.dumps(result._asdict()), flush=True)
    if refused:
        note(f"refused {refused} of {refused + len(seen)} frames")
    return SOME_REFUSED if refused else 0


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    plain: dict[str, Any] = Settings()._asdict()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, help="the .onnx file")
    parser.add_argument("source", type=Path, nargs="+", help="files or folders of frames, or -")
    parser.add_argument("--exclude", type=int, default=plain["exclude"])
    parser.add_argument("--threshold", type=float, default=plain["threshold"])
    parser.add_argument("--absolute", action="store_true", help="the threshold is a score")
    parser.add_argument("--temporal", type=int, default=plain["temporal"])
    return parser


def main() -> int:
    """The command line; errors are one line."""
    parser = arguments()
    given = parser.parse_args()
    if min(given.exclude, given.temporal) < 0 or (STDIN in given.source and len(given.source) > 1):
        parser.error("wanted --exclude and --temporal of at least 0, and - alone")
    try:
        return run(given)
    except (ValueError, OSError, ImportError) as error:
        note(f"loops_onnx: {one_line(error)}")
        return 2


if __name__ == "__main__":
    sys.exit(main())
