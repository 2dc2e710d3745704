"""docs/training.md from what the training runs left."""

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
"""What the mIoU may lose."""

HEAD = """# Training through the descriptor

Written by `scripts/pages/train_segmenter.py`; no number is typed by hand.
"""

NAMES = {"base": "before", "control": "cross-entropy alone", "place": "with the place loss"}

Outcomes = Sequence[dict[str, dict[str, Outcome]]]
"""One entry a seed: outcomes by the phase's name and the part of the frames."""


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
    """What was trained, on what, and how it is measured."""
    base, _, place = phases
    weights = sum(weight.numel() for weight in CompactNetwork(11).parameters())
    height, width = options.size
    settings = ", ".join(f"{name} {value:g}" for name, value in PAIRS.items())
    yield "## What was done\n"
    yield paragraph(
        f"A network of {weights} weights (`scripts/pages/_train_network.py`) learns CamVid's "
        f"eleven classes on {len(problem.training.frames)} frames of the drive {options.train} at "
        f"{height} x {width} pixels, mirrored, zoomed and in changed light, in batches of {BATCH}: "
        f"at most {base.steps} steps, until the mIoU of the drive's last "
        f"{len(problem.validation.frames)} frames has not risen in {base.patience} validations of "
        f"{base.every} steps; the best weights stay. From these it is fine-tuned twice, with the "
        f"same batches, rates and {place.steps} steps: with cross-entropy alone, and with "
        f"cross-entropy plus {place.place:g} times a multi-similarity loss. That loss compares the "
        "descriptors of the predictions (preset `default`, `surrogate=True`) with those of the "
        "hand-made label maps of all training frames, mirrored where the image is: the frame's own "
        f"is to be near, those of frames more than {FAR} away far ({settings})."
    )
    yield paragraph(
        f"All are measured on the {len(test.frames)} frames of the drive {options.test}, of which "
        "nothing was seen in training: another road at another time of day. Label maps are "
        "predicted at the size of the images and searched among the hand-made ones. `odd-even`: "
        "among those of the frames of the other parity, a neighbour must come first. `any frame`: "
        "among all, the frame's own or a neighbour. `cosine to own labels` is that of the two "
        "descriptors of a frame, of its prediction and of its label map. In brackets stand 95 % "
        f"bootstrap intervals over the frames ({RESAMPLES} resamples, the same frames for all "
        "seeds); they do not say how much other seeds, or other drives, would differ. mIoU is the "
        "mean over the classes that occur."
    )


def results(seeds: Sequence[int], found: Outcomes, perfect: Outcome) -> Iterator[str]:
    """Each seed, their means, the differences, and whether the claim is earned."""
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
    """The same figures on frames that were trained on, held out, and of the other drive."""
    yield paragraph(
        "Means over the seeds on frames that were trained on, on the end of the same drive, and on "
        "the other drive, as above:"
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
    """What the figures by part say of a claim that is not earned."""

    def mean(phase: str, part: str, figure: str = "cosine to own labels") -> float:
        return estimates([one[phase][part] for one in found])[figure][0]

    gains = [mean(phase, "test", RECALL) - mean("base", "test", RECALL) for phase in NAMES]

    before, control, place = (mean(phase, "training") for phase in NAMES)
    return (
        f"Why: against the network before, the place loss comes with {gains[2]:+.3f} of "
        f"RecallRate@1, but as many steps of cross-entropy alone with {gains[1]:+.3f}: the gain is "
        "that of the steps. The two losses want the same of the frames that they are trained on. "
        f"There a prediction's cosine to its own label map is {before:.3f} before, {control:.3f} "
        f"after more cross-entropy and {place:.3f} after the place loss: with a hand-made label "
        "map for every training frame, cross-entropy leaves the descriptor little to correct. On "
        f"the other drive the cosine is {mean('control', 'test'):.3f} and "
        f"{mean('place', 'test'):.3f}: what is missing there is missing through another light and "
        "another road, and on the frames of one short drive neither loss sees those. This "
        "says nothing of drives with images but no label maps, or of places seen twice, for which "
        "the loss needs no label maps at all; the data here have neither."
    )


def is_earned(difference: dict[str, Estimate]) -> bool:
    """More places beyond the interval, for at most a point of mIoU."""
    return difference[RECALL][1][0] > 0 and difference["mIoU"][0] >= -POINT


def verdict(difference: dict[str, Estimate]) -> str:
    """Whether the place loss finds more places, and what it costs in mIoU."""
    gain, (_, high) = difference[RECALL]
    lost = -difference["mIoU"][0]
    claim = "The claim, a higher RecallRate@1 at no more than one point of mIoU, "
    told = (
        f"against the control of as many steps: {RECALL} changes by {gain:+.3f}, mIoU by "
        f"{-lost:+.3f}."
    )
    if lost > POINT:
        return f"{claim}is not earned {told} It costs more than a point."
    if is_earned(difference):
        return f"{claim}is earned {told} The interval of the gain is above zero."
    if high < 0:
        return f"{claim}is not earned {told} Recall falls."
    return (
        f"{claim}is not earned {told} The interval of the change holds zero: so few frames do not "
        "tell it from chance."
    )


def logs(options: argparse.Namespace, phases: list[Phase]) -> Iterator[str]:
    """Where each run ended, from its log."""
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
