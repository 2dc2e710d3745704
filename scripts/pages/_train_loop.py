"""The training loop: phases with checkpoints, validation, early stop and a log.

A checkpoint holds all that the next step depends on, and a batch follows from its number, so a
run that was killed and started again ends with the same weights as one that was not.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from _train_data import CLASSES, VOID, Batch, Drive, draw, normalise
from rich.console import Console
from rich.progress import Progress
from torch import Tensor, nn

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.files import replacing
from ssrvlad_torch.soft.place_loss import multi_similarity

BATCH = 8
FAR = 10
"""The label maps of frames farther away than this show another place than a frame; those of nearer
frames are not used in the loss, except its own."""

PAIRS = {"alpha": 10.0, "beta": 50.0, "base": 0.9}
"""Settings of the loss: label maps of one street have cosines around 0.8."""


@dataclass(frozen=True)
class Phase:
    """One run of the loop.

    Attributes:
        name: of its folder.
        steps: batches at most.
        rate: learning rate of the first step; it falls to zero over the steps.
        every: steps between validations, each of which is kept as a checkpoint.
        place: weight of the place loss beside the cross-entropy.
        zoomed: whether views are zoomed.
        patience: validations without a better mIoU until it stops, and the best weights are
            taken; 0 runs to the end and takes the last.
    """

    name: str
    steps: int
    rate: float
    every: int = 50
    place: float = 0.0
    zoomed: bool = False
    patience: int = 0


class Problem(NamedTuple):
    """Frames to train on, frames to validate on, and the head whose descriptors are trained."""

    training: Drive
    validation: Drive
    head: SSRVLAD


@dataclass
class _State:
    """The state on which the next step depends."""

    network: nn.Module
    optimiser: torch.optim.Optimizer
    run: str
    step: int = 0
    best: float = -1.0
    stale: int = 0
    best_weights: dict[str, Tensor] = field(default_factory=dict)
    log: list[dict[str, float]] = field(default_factory=list)

    def save(self, path: Path) -> None:
        held = {"network": self.network.state_dict(), "optimiser": self.optimiser.state_dict()}
        plain = ("run", "step", "best", "stale", "best_weights", "log")
        with replacing(path) as temporary:
            torch.save({**held, **{name: getattr(self, name) for name in plain}}, temporary)

    def load(self, path: Path) -> None:
        held = torch.load(path, weights_only=True)
        if held["run"] != self.run:
            raise ValueError(f"{path} is of another run ({held['run']}); expected {self.run}")
        self.network.load_state_dict(held.pop("network"))
        self.optimiser.load_state_dict(held.pop("optimiser"))
        for name, value in held.items():
            setattr(self, name, value)


Loss = Callable[[Batch, Tensor], tuple[Tensor, dict[str, float]]]


def train(network: nn.Module, phase: Phase, problem: Problem, folder: Path, seed: int) -> None:
    """Trains a network in place, from the last checkpoint of the folder if there is one.

    ``checkpoint.pt`` and ``log.csv`` are written at each validation.

    Raises:
        ValueError: the checkpoint is of a run with other settings or frames.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / "checkpoint.pt"
    optimiser = torch.optim.AdamW(network.parameters(), lr=phase.rate)
    state = _State(network, optimiser, _run(phase, problem, seed))
    if checkpoint.exists():
        state.load(checkpoint)
    loss = _loss(phase, problem)
    title = f"{folder.parent.name} {phase.name}"
    with Progress(disable=not Console().is_terminal) as progress:
        bar = progress.add_task(title, total=phase.steps, completed=state.step)
        while state.step < phase.steps and not (phase.patience and state.stale >= phase.patience):
            row = _step(state, phase, problem.training, loss, seed)
            progress.advance(bar)
            if state.step % phase.every == 0 or state.step == phase.steps:
                _validate(state, row, problem)
                state.save(checkpoint)
                _write_log(folder / "log.csv", state.log)
                told = ", ".join(f"{key} {value:.4g}" for key, value in state.log[-1].items())
                progress.console.print(f"{title}: {told}", soft_wrap=True)
    if phase.patience and state.best_weights:
        network.load_state_dict(state.best_weights)


def _run(phase: Phase, problem: Problem, seed: int) -> str:
    """Settings in which a checkpoint must agree with a run that resumes from it."""
    drive = problem.training
    size = "x".join(str(length) for length in drive.images.shape[:3])
    return f"{phase}, {PAIRS}, seed {seed}, {size} from {drive.frames[0]}"


def _step(state: _State, phase: Phase, drive: Drive, loss: Loss, seed: int) -> dict[str, float]:
    """One batch forward and backward; returns the values for the log."""
    for group in state.optimiser.param_groups:
        group["lr"] = phase.rate * (1 - state.step / phase.steps) ** 0.9
    batch = draw(drive, BATCH, seed * 10**6 + state.step, phase.zoomed)
    state.network.train()
    total, parts = loss(batch, state.network(batch.images))
    state.optimiser.zero_grad()
    total.backward()
    state.optimiser.step()
    state.step += 1
    return parts


def _loss(phase: Phase, problem: Problem) -> Loss:
    """Cross-entropy, and the place loss against the label maps of all frames if it has a weight."""
    bank = _bank(problem) if phase.place else None

    def loss(batch: Batch, scores: Tensor) -> tuple[Tensor, dict[str, float]]:
        entropy = F.cross_entropy(scores, batch.targets, ignore_index=VOID)
        if bank is None:
            return entropy, {"cross_entropy": float(entropy.detach())}
        references = bank[batch.mirrored.long()]
        similarity = torch.einsum("bd,bnd->bn", problem.head(scores), references)
        apart = (batch.rows[:, None] - torch.arange(bank.shape[1])).abs()
        place = multi_similarity(similarity, apart == 0, apart > FAR, **PAIRS)
        parts = {"cross_entropy": float(entropy.detach()), "place_loss": float(place.detach())}
        return entropy + phase.place * place, parts

    return loss


def _bank(problem: Problem) -> Tensor:
    """``(2, n, 480)``: the descriptors of the label maps, and of their mirror images."""
    labels = problem.training.labels
    return torch.stack([describe(problem.head, maps) for maps in (labels, labels.flip(-1))])


@torch.no_grad()
def describe(head: SSRVLAD, labels: Tensor) -> Tensor:
    """``(n, 480)`` descriptors of label maps, a few at a time."""
    return torch.cat([head(part) for part in labels.split(BATCH)])


def _validate(state: _State, row: dict[str, float], problem: Problem) -> None:
    """Adds a line to the log, and stores the weights if they are the best so far."""
    predicted = predict(state.network, problem.validation.images)
    score = mean_iou(confusion(predicted, problem.validation.targets).sum(0))
    state.log.append({"step": state.step, **row, "validation_miou": score})
    state.stale += 1
    if score > state.best:
        weights = {name: value.clone() for name, value in state.network.state_dict().items()}
        state.best, state.stale, state.best_weights = score, 0, weights


@torch.no_grad()
def predict(network: nn.Module, images: Tensor) -> Tensor:
    """``(n, h, w)`` labels of ``(n, h, w, 3)`` uint8 images."""
    network.eval()
    parts = (part.permute(0, 3, 1, 2).float() / 255 for part in images.split(BATCH))
    return torch.cat([network(normalise(part)).argmax(1) for part in parts])


def confusion(predicted: Tensor, labels: Tensor) -> Tensor:
    """``(n, 11, 11)`` int64 pixels of each image by label and prediction, void left out."""
    entries = labels.long() * CLASSES + predicted.long()
    counted = [part[known != VOID] for part, known in zip(entries, labels, strict=True)]
    counts = [torch.bincount(part, minlength=CLASSES**2) for part in counted]
    return torch.stack(counts).view(-1, CLASSES, CLASSES)


def mean_iou(counts: Tensor) -> float:
    """Mean over the classes that occur of intersection over union, of ``(11, 11)`` counts."""
    both = counts.diagonal()
    union = counts.sum(0) + counts.sum(1) - both
    return float((both / union)[counts.sum(1) > 0].mean())


def _write_log(path: Path, rows: list[dict[str, Any]]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
