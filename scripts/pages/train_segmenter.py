#!/usr/bin/env python3
"""Trains a compact segmentation network, fine-tunes it for places and writes docs/training.md.

    .venv/bin/python scripts/pages/train_segmenter.py --camvid ../shared/data/camvid

A network is trained on one drive with cross-entropy, then fine-tuned twice for the same number of
steps: with cross-entropy alone (the control), and with an additional place loss on the descriptors
of its label maps, by `SSRVLAD(..., surrogate=True)`. All three networks are measured on the other
drive. Checkpoints and logs are stored in `--work`, so an interrupted run can be resumed. Any layout
of CamVid is accepted, see `ssrvlad_torch/datasets/camvid.py`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from _markdown import write
from _train_data import CLASSES, SPACE, Drive, read_drive
from _train_export import write_onnx
from _train_loop import Phase, Problem, train
from _train_measure import Outcome, outcome, predict_at_size
from _train_network import CompactNetwork
from _train_report import page

from ssrvlad_torch import SSRVLAD

BASE = Phase("base", steps=1200, rate=3e-3, every=100, zoomed=True, patience=6)
CONTROL = Phase("control", steps=200, rate=1e-3)
PLACE = Phase("place", steps=200, rate=1e-3, place=2.0)

VALIDATION = 0.15
"""Fraction of the drive at its end that is kept from training."""

GAP = 3
"""Frames between those that are trained on and those that are validated on."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, required=True, help="folder of CamVid")
    arguments.add_argument("--train", default="0016E5", help="drive to train on")
    arguments.add_argument("--test", default="0001TP", help="drive to measure on")
    arguments.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    arguments.add_argument("--size", type=int, nargs=2, default=[120, 160], metavar=("H", "W"))
    arguments.add_argument("--steps", type=int, default=BASE.steps, help="of the base at most")
    arguments.add_argument("--fine-tune-steps", type=int, default=PLACE.steps)
    arguments.add_argument("--onnx", type=Path, help="write the first seed's last network here")
    arguments.add_argument("--work", type=Path, default=Path(".cache/training"))
    arguments.add_argument("--output", type=Path, default=Path("docs/training.md"))
    options = arguments.parse_args()
    torch.set_num_threads(1)

    height, width = options.size
    test = read_drive(options.camvid, options.test, (height, width))
    drive = read_drive(options.camvid, options.train, (height, width))
    problem = split(drive, SSRVLAD.from_preset("default", surrogate=True, labels_as=SPACE))
    phases = [
        replace(BASE, steps=options.steps),
        *(replace(phase, steps=options.fine_tune_steps) for phase in (CONTROL, PLACE)),
    ]
    found = []
    for seed in options.seeds:
        torch.manual_seed(seed)
        network, folder = CompactNetwork(CLASSES), options.work / f"seed{seed}"
        found.append(one_seed(network, phases, problem, test, folder, seed))
        if options.onnx and len(found) == 1:
            write_onnx(network, (height, width), options.onnx)
    write(options.output, page(options, phases, problem, test, found))


def split(drive: Drive, head: SSRVLAD) -> Problem:
    """The drive's end for validation, the rest but a few frames for training."""
    frames = len(drive.frames)
    first = frames - max(1, round(frames * VALIDATION))
    return Problem(drive.rows(0, max(1, first - GAP)), drive.rows(first, frames), head)


def one_seed(
    network: CompactNetwork,
    phases: list[Phase],
    problem: Problem,
    test: Drive,
    folder: Path,
    seed: int,
) -> dict[str, dict[str, Outcome]]:
    """Trains the base, then each of the others from it; measures all."""
    found = {}
    base, *fine_tuned = phases
    train(network, base, problem, folder / base.name, seed)
    weights = {name: value.clone() for name, value in network.state_dict().items()}
    found[base.name] = measured(network, test, problem)
    for phase in fine_tuned:
        network.load_state_dict(weights)
        train(network, phase, problem, folder / phase.name, 1000 + seed)
        found[phase.name] = measured(network, test, problem)
    return found


def measured(network: CompactNetwork, test: Drive, problem: Problem) -> dict[str, Outcome]:
    """What came of the first training frames, of those held out, and of the other drive."""
    training = problem.training.rows(0, len(test.frames))
    drives = {"training": training, "validation": problem.validation, "test": test}
    return {
        name: outcome(predict_at_size(network, drive), drive, problem.head)
        for name, drive in drives.items()
    }


if __name__ == "__main__":
    main()
