#!/usr/bin/env python3
"""Finds a drive along a map with an exported or fused file: `run_onnx.py` for whole sequences.

python export/follow_onnx.py place.onnx photos/today --database photos.npy

Takes the steps of `ssrvlad query` that need no torch. Own mean off: descriptors lose the mean of
their drive if it has 30 frames, else that of all. So do features and HOG, which are fused with them
where the file and the database have some; features are moved to both sides, as `ssrvlad query` does
without `--no-sweep`. Follow: a hidden Markov model over the rows of the map finds each folder as a
sequence, with its later frames too. It does not ask whether the frames are a sequence along the
map, which `ssrvlad query` does, and it takes every drive to run at 0 to 4 rows a frame: give it
drives only, and single pictures to `run_onnx.py`. Prints for each frame the best rows with their
probabilities; the first is that of the place, a few rows wide. Needs numpy, onnxruntime, and the
folder `ssrvlad_place` beside it. Memory: 56 bytes for each pair of a frame and a row, and 256 kB
for each frame and row with features. Exit code 0 for success, 2 for
wrong use, 3 for finished with some frames skipped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from ssrvlad_place import motion
from ssrvlad_place.database import Database
from ssrvlad_place.frames import find_frames
from ssrvlad_place.model import Seen, add_model, open_model
from ssrvlad_place.motion import GAP, LEVEL, MAX_LOG, PRIOR, STAY
from ssrvlad_place.output import finished, note, one_line, report, run_program
from ssrvlad_place.scores import FEATURES, REACH, fused, lead, nearness, weights_of

Floats = npt.NDArray[np.float32]

AHEAD = (1,)
"""The way in which a drive runs the map."""
UNMAPPED, CHANGE, WEIGHT = 0.1, 0.05, 0.3
"""Probabilities of a jump to a place that the map lacks and of a changed speed, and the weight of a
z-score."""
NEAR = 3
"""Rows on each side of a row that show its place."""
MIN_FRAMES = 30
"""Least number of frames of a drive whose own mean is subtracted."""

_SAMPLE = 200
_ROUNDING = 1e-6


def without_means(descriptors: Floats, sequences: Sequence[str]) -> Floats:
    """``(N, D)`` or ``(N, S, D)`` descriptors without the mean of their drive, of length 1 or zero;
    as they are if there are fewer than `MIN_FRAMES`."""
    anchors = descriptors.reshape(len(descriptors), -1, descriptors.shape[-1]).astype(np.float32)
    if len(anchors) < MIN_FRAMES:
        return anchors
    after, names = np.zeros_like(anchors), np.array(sequences)
    for name in dict.fromkeys(sequences):
        rows = names == name
        of = anchors[rows] if np.count_nonzero(rows) >= MIN_FRAMES else anchors
        mean = of[of.any(axis=2)].mean(axis=0, dtype=np.float64).astype(np.float32)
        after[rows] = np.where(anchors[rows].any(axis=2, keepdims=True), anchors[rows] - mean, 0)
    return after / np.maximum(np.linalg.norm(after, axis=2, keepdims=True), _ROUNDING)


def scores_of_drive(drive: Sequence[Seen], name: str, database: Database) -> Floats:
    """``(Q, R)`` scores of the frames of a drive to those of a map, fused of all channels that both
    have. The weights of fewer than `MIN_FRAMES` frames are those of single frames."""
    sequences, standardised = [name] * len(drive), len(drive) >= MIN_FRAMES
    names = [frame.rpartition("/")[0] for frame in database.frames]
    parts: dict[str, Floats] = {}
    for channel, rows in database.channels.items():
        queries = np.stack([seen.channels[channel] for seen in drive])
        if channel == FEATURES:
            sides = (numbers(queries, sequences, standardised), numbers(rows, names, standardised))
            parts[channel] = scores_of_signs(*sides)
        else:
            references = np.asarray(rows, np.float32)
            parts[channel] = scores_of_vectors(queries, references, sequences, names, standardised)
    if len(parts) == 1:
        return next(iter(parts.values()))
    leads = {each: mean_lead(scores) if standardised else 0.0 for each, scores in parts.items()}
    weights = weights_of(leads)
    return np.stack([fused(row, weights) for row in zip(*parts.values(), strict=True)]).astype(
        np.float32
    )


def scores_of_vectors(
    queries: Floats,
    references: Floats,
    sequences: Sequence[str],
    names: Sequence[str],
    standardised: bool,
) -> Floats:
    """``(Q, R)`` cosines of vectors ``(Q, D)``, or ``(Q, S, D)`` by the best anchor, to those
    of ``(R, D)``, without the means of their drives if standardised; -inf where one is zero."""
    rows = without_means(references, names)[:, 0] if standardised else references
    scores: Floats = (without_means(queries, sequences) @ rows.T).max(axis=1)
    scores[:, ~rows.any(axis=1)] = -np.inf
    scores[~queries.reshape(len(queries), -1).any(axis=1)] = -np.inf
    return scores


def scores_of_signs(queries: Floats, references: Floats) -> Floats:
    """``(Q, R)`` cosines of features as numbers ``(N, 16, 2048)``, for the best move of a query."""
    best = np.full((len(queries), len(references)), -1, np.float32)
    columns = queries.shape[1]
    for move in range(-REACH, REACH + 1):
        ours = queries[:, max(0, -move) : columns - max(0, move)].reshape(len(queries), -1)
        theirs = references[:, max(0, move) : columns - max(0, -move)].reshape(len(references), -1)
        lengths = [np.maximum(np.linalg.norm(each, axis=1), _ROUNDING) for each in (ours, theirs)]
        np.maximum(best, ours @ theirs.T / np.outer(*lengths), out=best)
    return best


def numbers(signs: Any, sequences: Sequence[str], standardised: bool) -> Floats:
    """Features ``(N, 16, 16, 16)`` as 1 and -1, without the mean of their drive if standardised."""
    bits = np.unpackbits(np.asarray(signs), axis=-1, bitorder="little")
    signed = bits.reshape(len(bits), -1).astype(np.float32) * 2 - 1
    rows = without_means(signed, sequences)[:, 0] if standardised else signed
    return rows.reshape(len(bits), bits.shape[1], -1)


def mean_lead(scores: Floats) -> float:
    """The mean lead of the first candidates over a sample of the queries ``(Q, R)``."""
    return float(np.mean([lead(row) for row in scores[:: max(1, len(scores) // _SAMPLE)]]))


class Track:
    """A hidden Markov model of a drive along a map; see `ssrvlad_torch.recognition.follow`.

    Args:
        sequences: the sequence of each row of the map; no step leads from one into the next.
    """

    def __init__(self, sequences: Sequence[str]) -> None:
        groups = [len(list(rows)) for _, rows in groupby(sequences)]
        self.first = np.repeat(np.cumsum([0, *groups[:-1]]), groups)
        self.last = np.repeat(np.cumsum(groups), groups)
        starts = np.cumsum([GAP, *(rows + GAP for rows in groups)])
        self.cells = np.concatenate(
            [np.arange(n) + s for n, s in zip(groups, starts, strict=False)]
        )
        self.inside = np.zeros(int(starts[-1]), np.float32)
        self.inside[self.cells] = 1
        ones = np.ones((1, len(PRIOR), len(self.inside)), np.float32)
        self._left = 1 - self._back(ones)

    def rows(self, scores: Floats) -> Floats:
        """``(Q, R)`` probabilities of the rows, by ``(Q, R)`` scores; -inf where there is none."""
        likelihoods = [self._likelihood(row) for row in scores]
        mapped, unmapped = motion.start(self.inside, UNMAPPED, AHEAD), UNMAPPED
        beliefs = []
        for number, likelihood in enumerate(likelihoods):
            if number:
                before = mapped, unmapped, self.inside
                mapped, unmapped = motion.after(*before, UNMAPPED, CHANGE, AHEAD)
            mapped = mapped * likelihood
            total = float(mapped.sum()) + unmapped
            mapped, unmapped = mapped / np.float32(total), unmapped / total
            beliefs.append(mapped)
        later, later_unmapped = np.ones_like(mapped), 1.0
        found = np.zeros_like(scores)
        for number in reversed(range(len(likelihoods))):
            each = beliefs[number] * later
            belief_unmapped = 1 - float(beliefs[number].sum())
            total = float(each.sum()) + belief_unmapped * later_unmapped
            found[number] = each[0].sum(axis=0)[self.cells] / max(total, 1e-30)
            later, later_unmapped = self._before(later * likelihoods[number], later_unmapped)
        return found

    def _likelihood(self, scores: Floats) -> Floats:
        near, known = nearness(scores), np.isfinite(scores)
        spread = float(near[known].std()) if known.any() else 0.0
        cells = np.zeros_like(self.inside)
        if spread <= _ROUNDING:
            cells[self.cells] = 1
            return cells
        z = np.where(known, (near - near[known].mean()) / spread, -np.inf)
        cells[self.cells] = np.exp(np.minimum(WEIGHT * (z - LEVEL), MAX_LOG))
        return cells

    def _back(self, mapped: Floats) -> Floats:
        """By the transposed steps of each speed."""
        return motion.moved(mapped * self.inside, self.inside, [-way for way in AHEAD])

    def _before(self, mapped: Floats, unmapped: float) -> tuple[Floats, float]:
        """How likely the later frames are from each state one frame earlier; not normalised."""
        anywhere = float((PRIOR * mapped * self.inside).sum()) / len(self.cells)
        elsewhere = UNMAPPED * unmapped + (1 - UNMAPPED) * anywhere
        before = self._back(mapped) + self._left * np.float32(elsewhere)
        before = before * (1 - CHANGE) + CHANGE * (PRIOR * before).sum(axis=1, keepdims=True)
        before_unmapped = STAY * unmapped + (1 - STAY) * anywhere
        largest = max(float(before.max()), before_unmapped, 1e-30)
        return (before / np.float32(largest)).astype(np.float32), before_unmapped / largest


def candidates(
    rows: Floats, scores: Floats, track: Track, frames: Sequence[str], top: int
) -> list[tuple[str, float]]:
    """The likeliest rows of a frame, none without a score; the probability of the first is that of
    its place, in its sequence."""
    best = [row for row in np.argsort(-rows, kind="stable") if np.isfinite(scores[row])][:top]
    ranked = [(frames[row], float(rows[row])) for row in best]
    if not best:
        return ranked
    first, last = track.first[best[0]], track.last[best[0]]
    near = rows[max(first, best[0] - NEAR) : min(last, best[0] + NEAR + 1)].sum()
    return [(ranked[0][0], min(1.0, float(near))), *ranked[1:]]


def run(options: argparse.Namespace) -> int:
    """Runs the program; the exit code."""
    model = open_model(options)
    database = Database(options.database, model.fingerprints)
    if not database.frames:
        raise ValueError(f"{options.database} holds no frames")
    described: dict[str, Seen] = {}
    skipped = 0
    for frame, path in find_frames(options.source, model.suffixes):
        try:
            if frame in described:
                raise ValueError(f"a second frame {frame}")
            described[frame] = model.see(path)
        except ValueError as error:
            note(f"{path}: {one_line(error)}")
            skipped += 1
    names = [frame.rpartition("/")[0] for frame in database.frames]
    track = Track(names)
    for sequence, group in groupby(described, lambda frame: frame.rpartition("/")[0]):
        drive = list(group)
        scores = scores_of_drive([described[frame] for frame in drive], sequence, database)
        for frame, found, row in zip(drive, track.rows(scores), scores, strict=True):
            ranked = candidates(found, row, track, database.frames, options.top)
            report(frame, not described[frame].descriptor.any(), ranked, options.json)
    return finished(skipped, len(described))


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("source", type=Path, nargs="+", help="folders of frames, each a drive")
    parser.add_argument("--database", type=Path, required=True, help=".npy file of a map")
    parser.add_argument("--top", type=int, default=5, help="candidates of each frame")
    parser.add_argument("--json", action="store_true", help="a JSON object a line")
    options = parser.parse_args()
    if options.top < 1:
        parser.error("expected --top of at least 1")
    return run_program("follow_onnx", run, options)


if __name__ == "__main__":
    sys.exit(main())
