"""The golden pair of a file, an input with its outputs, on this runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from ssrvlad_torch.deployment.differences import (
    FEATURES,
    HOG,
    LABELS,
    TOLERANCE,
    difference_of,
    problem_of_network,
)
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.files import one_line

from .output import note

MIN_COSINE = 0.8
"""Cosine of the descriptors of two label maps of which few labels differ; unlike maps have less."""


class Golden(NamedTuple):
    """The result of a golden pair: the largest difference of the descriptor, and what is wrong, or
    ``""``. Where some labels differ, the descriptor differs too, so only a large error of the head
    is found."""

    difference: float
    problem: str = ""

    def __str__(self) -> str:
        problem = f", {self.problem}" if self.problem else ""
        return f"largest difference for the golden pair: {self.difference:.3g}{problem}"


def run_golden(session: Any, name: str, metadata: Metadata) -> Golden:
    """Runs the golden pair of a file by the name of its input. Without one for the input, and where
    it cannot be run, a ValueError is raised."""
    golden = metadata.golden_arrays()
    if name not in golden or len(golden) < 2 or (name == LABELS and "descriptor" not in golden):
        raise ValueError(f"no golden pair for input {name}; see `ssrvlad verify`")
    inputs = {name: golden.pop(name)}
    try:
        outputs = dict(zip(golden, session.run(list(golden), inputs), strict=True))
    except Exception as error:  # ONNX Runtime has no common error type
        raise ValueError(f"cannot run the golden pair: {one_line(error)}") from error
    problem = problem_of_network(outputs, golden) if LABELS in golden else ""
    head = {key: golden[key] for key in golden if key not in (LABELS, FEATURES, HOG)}
    difference, of_head = difference_of(outputs, head)
    if of_head and not problem and LABELS in golden and (outputs[LABELS] != golden[LABELS]).any():
        cosine = (outputs["descriptor"] * golden["descriptor"]).sum(-1).min()
        of_head = "" if cosine >= MIN_COSINE else of_head
    return Golden(difference, problem or of_head)


def require_golden(path: Path, golden: Golden) -> None:
    """Refuses a runtime whose golden pair is wrong."""
    if golden.problem:
        raise ValueError(
            f"{path} is computed wrong here ({golden}); `ssrvlad verify --provider` says where, "
            "--unchecked runs it anyway"
        )
    if golden.difference > TOLERANCE:
        note(f"{path}: {golden}: the head was checked roughly; `ssrvlad verify` checks it exactly")
