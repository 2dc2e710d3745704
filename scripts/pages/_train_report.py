"""Writes docs/training.md from the results of the training runs."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from _markdown import head_row, interval, paragraph, row
from _train_data import Drive
from _train_loop import BATCH, FAR, PAIRS, Phase, Problem
from _train_measure import FIGURES, RESAMPLES, Estimate, Outcome, estimates, outcome
from _train_network import CompactNetwork
from _train_twin import page_parts

RECALL = "RecallRate@1, odd-even"
POINT = 0.01
"""The largest accepted loss of mIoU."""

HEAD = """# Training through the descriptor

Written by `scripts/pages/train_segmenter.py`. Is a segmentation network better for place
recognition after fine-tuning with a place loss on its descriptors?
"""

NAMES = {"base": "before", "control": "cross-entropy alone", "place": "with the place loss"}

Outcomes = Sequence[dict[str, dict[str, Outcome]]]
"""One entry per seed: outcomes by name of the phase and part of the frames."""


def page(
    options: argparse.Namespace,
    phases: list[Phase],
    problem: Problem,
    test: Drive,
    found: Outcomes,
) -> str:
    """The whole page."""
    perfect = outcome(test.labels, test, problem.head)
    drives = {
        f"CamVid {options.train}": problem.training,
        f"CamVid {options.test}": test,
    }
    parts = [
        HEAD,
        *setting(options, phases, problem, test),
        *results(options.seeds, found, perfect),
        *logs(options, phases),
        *page_parts(drives),
    ]
    return "\n".join(parts) + "\n"


def setting(
    options: argparse.Namespace, phases: list[Phase], problem: Problem, test: Drive
) -> Iterator[str]:
    """Lines about the network, the data, the losses and the metrics."""
    base, _, place = phases
    weights = sum(weight.numel() for weight in CompactNetwork(11).parameters())
    height, width = options.size
    settings = ", ".join(f"{name} {value:g}" for name, value in PAIRS.items())
    training, held_out = len(problem.training.frames), len(problem.validation.frames)
    yield f"""\
## Method

1. *Before*: a network of {weights} weights (`scripts/pages/_train_network.py`) learns the eleven
   classes of CamVid on {training} frames of the drive {options.train} at {height} x {width} pixels,
   in batches of {BATCH}, with mirroring, zoom and changed light. It trains for at most {base.steps}
   steps and stops when the mIoU of the last {held_out} frames of the drive has not risen in
   {base.patience} validations, one every {base.every} steps. The best weights are taken.
2. *Cross-entropy alone*: the weights of 1 are fine-tuned for {place.steps} steps.
3. *With the place loss*: the weights of 1 are fine-tuned with the same batches, rate and number of
   steps, with cross-entropy plus {place.place:g} times a multi-similarity loss. This loss compares
   the descriptors of the predictions (preset `default`, `surrogate=True`) with those of the
   hand-made label maps of all training frames. The label map of the same frame should be near,
   those of frames more than {FAR} away should be far ({settings}).

All are measured on the {len(test.frames)} frames of the drive {options.test}: another road at
another time of day, not used in training. Label maps are predicted at the size of the images.

- *mIoU* is the mean over the classes that occur.
- *RecallRate@1, odd-even*: predictions are searched among the hand-made label maps of the frames of
  the other parity; a neighbour must come first.
- *RecallRate@1, any frame*: predictions are searched among the label maps of all frames; the same
  frame or a neighbour must come first.
- *Cosine to own labels* is the cosine between the descriptors of a prediction and of the hand-made
  label map of the same frame.
- In brackets are 95 % bootstrap intervals over the frames ({RESAMPLES} resamples, the same frames
  for all seeds). They do not cover the variation between seeds or drives.
"""


def results(seeds: Sequence[int], found: Outcomes, perfect: Outcome) -> Iterator[str]:
    """Tables of each seed, of the means and of the differences, and the conclusion."""
    yield "## Before and after\n"
    yield from head_row("seed", "network", *FIGURES)
    for seed, outcomes in zip(seeds, found, strict=True):
        for phase, parts in outcomes.items():
            yield row(str(seed), NAMES[phase], *_cells(estimates([parts["test"]])))
    every = {phase: [one[phase]["test"] for one in found] for phase in NAMES}
    for phase, several in every.items():
        yield row("mean", NAMES[phase], *_cells(estimates(several)))
    yield row("-", "hand-made labels", *_cells(estimates([perfect])))
    yield ""
    yield "Differences of the means, on the same frames:\n"
    yield from head_row("difference", *FIGURES)
    compared = {
        "with the place loss - cross-entropy alone": ("place", "control"),
        "with the place loss - before": ("place", "base"),
        "cross-entropy alone - before": ("control", "base"),
    }
    for name, (one, other) in compared.items():
        yield row(name, *_cells(estimates(every[one], every[other]), sign="+"))
    yield ""
    difference = estimates(every["place"], every["control"])
    yield paragraph(verdict(difference))
    yield from where(found)
    if not is_earned(difference):
        yield paragraph(why(found))


def where(found: Outcomes) -> Iterator[str]:
    """The table of the figures on training frames, validation frames and the other drive."""
    yield paragraph(
        "Means over the seeds on the training frames, on the end of the same drive (validation), "
        "and on the other drive (test):"
    )
    yield from head_row("frames", "network", *FIGURES)
    for part in found[0]["base"]:
        for phase, name in NAMES.items():
            several = [one[phase][part] for one in found]
            yield row(part, name, *_cells(estimates(several)))
    yield ""


def _cells(found: dict[str, Estimate], sign: str = "") -> Iterator[str]:
    for value, (low, high) in found.values():
        if sign:
            yield f"{value:+.3f} [{low:+.3f}, {high:+.3f}]"
        else:
            yield interval(value, (low, high))


def why(found: Outcomes) -> str:
    """The explanation of a negative result by the figures of each part."""

    def mean(phase: str, part: str, figure: str = "cosine to own labels") -> float:
        return estimates([one[phase][part] for one in found])[figure][0]

    gains = [mean(phase, "test", RECALL) - mean("base", "test", RECALL) for phase in NAMES]

    before, control, place = (mean(phase, "training") for phase in NAMES)
    return (
        "Why? RecallRate@1 is higher than before by "
        f"{gains[2]:+.3f} with the place loss, and by {gains[1]:+.3f} with as many steps of "
        "cross-entropy alone: the gain comes from the steps. On the training frames, the cosine of "
        f"a prediction to its own label map is {before:.3f} before, {control:.3f} after "
        f"cross-entropy alone and {place:.3f} after the place loss. With a hand-made label map for "
        "every training frame, cross-entropy already makes the descriptors right. On the other "
        f"drive the cosine is {mean('control', 'test'):.3f} and {mean('place', 'test'):.3f}: the "
        "light and the road are different, and one short drive does not show these to either "
        "loss. Not tested, because the data do not have them: drives with images but without label "
        "maps, and places that are seen twice, for which the place loss needs no label maps."
    )


def is_earned(difference: dict[str, Estimate]) -> bool:
    """Whether the gain is above zero with its interval, at a loss of at most a point of mIoU."""
    return difference[RECALL][1][0] > 0 and difference["mIoU"][0] >= -POINT


def verdict(difference: dict[str, Estimate]) -> str:
    """Whether the place loss raises RecallRate@1, and the change of mIoU."""
    gain, (_, high) = difference[RECALL]
    lost = -difference["mIoU"][0]
    answer, reason = "No", "The interval of the change contains zero, so it may be chance."
    if lost > POINT:
        reason = "The loss of mIoU is more than one point."
    elif is_earned(difference):
        answer, reason = "Yes", "The interval of the gain is above zero."
    elif high < 0:
        reason = "Recall falls."
    return (
        "Does the place loss raise RecallRate@1 at a loss of at most one point of mIoU? "
        f"**{answer}**: compared with as many steps of cross-entropy alone, {RECALL} changes by "
        f"{gain:+.3f}, mIoU by {-lost:+.3f}. {reason}"
    )


def logs(options: argparse.Namespace, phases: list[Phase]) -> Iterator[str]:
    """The table of the last log line of each run."""
    yield "## The runs\n"
    yield "The last line of each log, `<work>/seed<n>/<phase>/log.csv`:\n"
    yield from head_row("seed", "phase", "steps", "cross-entropy", "place loss", "validation mIoU")
    for seed in options.seeds:
        for phase in phases:
            last = _last_line(options.work / f"seed{seed}" / phase.name / "log.csv")
            names = ("cross_entropy", "place_loss", "validation_miou")
            cells = (f"{float(last[name]):.3f}" if name in last else "-" for name in names)
            yield row(str(seed), phase.name, last["step"], *cells)
    yield ""


def _last_line(path: Path) -> dict[str, str]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))[-1]
