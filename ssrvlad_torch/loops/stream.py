"""Loop closures over files: folders of frames, or names that arrive one by one."""

from collections import Counter
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..channels.channel import Network
from ..database.database import Database
from ..datasets.names import sequence_of
from ..encoding.encoder import Describer, check_segmenter, method_for
from ..encoding.results import Encoded, Note, Skipped, do_nothing
from ..evaluation.curves import Rows
from ..evaluation.loops import loop_curve, loop_errors, score_loops, surest_point
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .config import LoopConfig
from .detector import LoopDetector
from .result import LoopResult

CHECKPOINT_FRAMES = 500
"""Frames between two checkpoints of a stream."""


def open_detector(
    config: LoopConfig,
    memory: str | Path | None,
    preset: str | None,
    labels_as: str | LabelSpace,
    network: Network | None = None,
    channels: Sequence[str] | None = None,
    note: Note = do_nothing,
) -> tuple[LoopDetector, Database | None]:
    """A detector, and the database that it was loaded from and is saved to: the folder or URI
    ``memory``, created if it does not exist; without it, nothing is saved. Without a preset or
    names of channels, those of the database, or ``default`` and all that the frames have; others,
    and a damaged database, are a ValueError."""
    stored = Database.open(memory) if memory is not None and Database.exists(memory) else None
    head, beside = method_for(stored, preset, labels_as, network, channels, note)
    if memory is None:
        return LoopDetector(config, head, beside), None
    columns = [channel.column for channel in beside]
    database = Database.open_or_create(memory, head.config, columns)
    return LoopDetector.load(database, config, head), database


def describer_of(detector: LoopDetector, network: Segmenter | None = None) -> Describer:
    """What describes the frames of a detector; a network that does not fit is a ValueError."""
    check_segmenter(network, detector.head, detector.channels)
    return Describer(detector.channels, detector.head.label_space, detector.columns)


def detect_loops(
    detector: LoopDetector, frames: Iterable[Encoded | Skipped], database: Database | None = None
) -> Generator[LoopResult | Skipped]:
    """Passes frames to a detector, in order; a frame that it cannot use is skipped. The detector is
    saved to the database every `CHECKPOINT_FRAMES` frames and when the stream ends or fails."""
    try:
        for frame in frames:
            result: LoopResult | Skipped
            if isinstance(frame, Skipped):
                result = frame
            else:
                described = {n: torch.from_numpy(values) for n, values in frame.descriptors.items()}
                try:
                    result = detector.observe(frame.record, described)
                except ValueError as error:
                    result = Skipped(frame.record.frame, str(error))
            yield result
            if database and len(detector) >= len(database) + CHECKPOINT_FRAMES:
                detector.save(database)
    finally:
        if database:
            detector.save(database)


def loops_of(detector: LoopDetector, results: Sequence[LoopResult]) -> Rows:
    """``(N,)`` int64: the row of the frame to which each frame closes a loop, -1 for none."""
    return rows_of_candidates(detector, [result for result in results if result.accepted])


def rows_of_candidates(detector: LoopDetector, results: Sequence[LoopResult]) -> Rows:
    """``(N,)`` int64: the row of each frame's candidate in the results, -1 for none."""
    row = {frame: number for number, frame in enumerate(detector.frames)}
    candidates = np.full(len(row), -1, np.int64)
    for result in results:
        if result.candidate is not None:
            candidates[row[result.frame]] = row[result.candidate]
    return candidates


def report(
    detector: LoopDetector, results: Sequence[LoopResult], metres: float | None = None
) -> dict[str, Any]:
    """A summary of the results of a detector's last frames: ``frames``, ``reasons`` (the number of
    each), ``steps`` (as taken), and with the largest distance of a right loop in metres the counts
    of `LoopScore`, ``precision``, ``recall``, and ``suggested``: the threshold of
    `evaluation.loops.surest_point` as a mapping, ``None`` if no candidate is right. A distance, but
    no frame with a pose, is a ValueError."""
    counts = Counter(result.reason.value for result in results)
    steps = {"standardised": "mean so far", "sweep": list(detector.columns), "temporal": 0}
    steps |= {"follow": "online", "scan": detector.scans, "weights": detector.weights}
    summary: dict[str, Any] = {"frames": len(results), "reasons": dict(counts), "steps": steps}
    if metres is not None:
        exclude = detector.config.exclude
        loops = loops_of(detector, results)
        first = len(loops) - len(results)
        sequences = [sequence_of(frame) for frame in detector.frames]
        score = score_loops(loops, detector.poses, exclude, metres, first, sequences)
        summary |= {**score._asdict(), "precision": score.precision, "recall": score.recall}
        judged = [result for result in results if result.confidence is not None]
        candidates = rows_of_candidates(detector, judged)
        errors = loop_errors(candidates, detector.poses)
        placed = np.isfinite(errors)
        confidences = np.array([result.confidence for result in judged], float)
        right = errors[placed] <= metres
        possible = score_loops(candidates, detector.poses, exclude, metres, first, sequences)
        point = surest_point(loop_curve(confidences[placed], right, possible.revisits))
        summary["suggested"] = point and point._asdict()
    return summary
