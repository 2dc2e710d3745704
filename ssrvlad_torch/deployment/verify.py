"""Verify: compares an exported or fused ONNX file on a runtime with the PyTorch module."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..config import SSRVLADConfig
from ..datasets.frame_file import FrameFile, Skipped
from ..datasets.label_files import LabelMap, read_label_map
from ..descriptor import SSRVLAD
from ..encoding.results import Progress, do_nothing
from ..files import one_line
from ..segmentation.onnx_files import CPU, load_model
from ..taxonomy import LabelSpace
from .fuse import IMAGE, LABELS, head_of, network_in, problem_of_network
from .golden import as_input, difference_of, outputs_of
from .metadata import PREFIX, Arrays, Metadata
from .runtimes import Runtime, runtime_of

if TYPE_CHECKING:
    import onnx

CANNOT = "cannot run"


class Check(NamedTuple):
    """A comparison: a frame's id or ``"golden pair"`` or ``"golden image"``, the largest difference
    of two descriptors, infinite for NaN or another shape, and what is wrong, or ``""``."""

    name: str
    difference: float
    problem: str


@dataclass
class Verification:
    """The result of `verify`: what runs the file; the version, fingerprint, label space, network
    (``None`` for a head alone) and fingerprints of channels in the file; problems of the file as a
    whole; comparisons; and frames that were not compared."""

    runtime: str
    version: str
    fingerprint: str
    labels_as: str
    network: str | None
    channels: dict[str, str]
    problems: list[str] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """How the runtime computes the file: ``"exact"``, ``"wrong"`` or ``"cannot run"``."""
        problem = next((check.problem for check in self.checks if check.problem), "")
        return ("cannot run" if problem.startswith(CANNOT) else "wrong") if problem else "exact"

    @property
    def difference(self) -> float:
        """Largest difference of two descriptors."""
        return max((check.difference for check in self.checks), default=0.0)

    @property
    def passed(self) -> bool:
        """Whether the file has no problem and the runtime computes it exactly."""
        return not self.problems and self.verdict == "exact"


def verify(
    path: str | Path,
    labels: Sequence[FrameFile] = (),
    provider: str = CPU,
    progress: Progress = do_nothing,
) -> Verification:
    """Compares a file of `export_head` or `fuse` on a runtime with the module: on its golden pair
    or image, and its head on label maps. Of the golden image 1 % of the labels and of the signs of
    features may differ, as runtimes compute networks differently; HOG and the descriptor of these
    labels must be those of the module.

    Args:
        path: the file.
        labels: label maps in the file's label space; a file of class scores gets 1 for a pixel's
            class and 0 for others.
        provider: execution provider of ONNX Runtime, or ``"openvino"``.
        progress: is called with 1 for each frame.

    Raises:
        ValueError: the file is damaged, was not written by `export_head` or `fuse`, has settings
            that this version lacks, or cannot run in ONNX Runtime on the CPU.
        ImportError: the runtime is not installed.
    """
    path = Path(path)
    model = load_model(path)
    try:
        return _verify(path, model, labels, runtime_of(provider), progress)
    except ImportError:
        raise
    except Exception as error:  # damaged metadata and graphs can raise anything
        reason = f"metadata lacks {error}" if isinstance(error, KeyError) else one_line(error)
        prefix = "" if reason.startswith(str(path)) else f"{path}: "
        raise ValueError(prefix + reason) from error


def _verify(
    path: Path,
    model: onnx.ModelProto,
    labels: Sequence[FrameFile],
    runtime: Runtime,
    progress: Progress,
) -> Verification:
    properties = {entry.key: entry.value for entry in model.metadata_props}
    metadata, network = Metadata.from_properties(properties), network_in(properties)
    space = LabelSpace.from_dict({"source": PREFIX, **metadata.label_space})
    config = replace(SSRVLADConfig.from_dict(metadata.config), labels_as=space)
    module = SSRVLAD(config, metadata.interface.get("sweep", ()))
    name, channels = (network.name, network.channels) if network else (None, {})
    facts = metadata.version, metadata.fingerprint, space.name, name, channels
    result, golden = Verification(runtime.name, *facts), metadata.golden_arrays()
    if config.fingerprint != metadata.fingerprint:
        result.problems.append(
            f"fingerprint {metadata.fingerprint} is not that of its settings in this version, "
            f"{config.fingerprint}"
        )
    if network:
        check = _checker(result, runtime, path)
        check("golden image", {IMAGE: golden[IMAGE]}, lambda got: _of_image(got, golden, module))
        if "descriptor" not in golden:
            return result
        model = head_of(model)
    check = _checker(result, runtime, model.SerializeToString() if network else path)
    value = model.graph.input[0]
    if not network:
        array = golden.pop(value.name)
        expected = golden or outputs_of(module, array)
        check("golden pair", {value.name: array}, lambda got: difference_of(got, expected))
    for frame in labels:
        try:
            array = _input_of(read_label_map(frame, space), value, space)
            outputs = outputs_of(module, array)
            if outputs["unknown"].any():
                module(array)  # raises an error that names the ids
        except ValueError as error:
            result.skipped.append(Skipped(frame.frame, str(error)))
        else:
            check(frame.frame, {value.name: array}, partial(difference_of, expected=outputs))
        progress(1)
    return result


def _checker(result: Verification, runtime: Runtime, source: Path | bytes) -> Callable[..., None]:
    """A function that runs a file, which is opened once, on inputs, judges its outputs and notes
    the check. An error is what is wrong; on ONNX Runtime on the CPU it is raised."""
    opened = cache(lambda: runtime.open(source))

    def check(name: str, inputs: Arrays, judge: Callable[[Arrays], tuple[float, str]]) -> None:
        try:
            outputs = opened()(inputs)
        except Exception as error:  # runtimes have no common error type
            if runtime.provider == CPU:
                raise
            result.checks.append(Check(name, np.inf, f"{CANNOT}: {one_line(error)}"))
        else:
            result.checks.append(Check(name, *judge(outputs)))

    return check


def _of_image(got: Arrays, golden: Arrays, module: SSRVLAD) -> tuple[float, str]:
    if problem := problem_of_network(got, golden):
        return np.inf, problem
    expected = outputs_of(module, got[LABELS]) if "descriptor" in golden else {}
    return difference_of(got, expected)


def _input_of(labels: LabelMap, value: onnx.ValueInfoProto, space: LabelSpace) -> npt.NDArray[Any]:
    """``(B, H, W)`` ids or ``(B, C, H, W)`` scores of a label map. An id that the input cannot
    hold, and another size than a fixed one, are a ValueError."""
    from onnx import helper

    kind = value.type.tensor_type
    dtype = helper.tensor_dtype_to_np_dtype(kind.elem_type)
    batch, *channels, height, width = (axis.dim_value for axis in kind.shape.dim)
    if height and width and labels.shape != (height, width):
        raise ValueError(f"a label map of {labels.shape}; the file takes {(height, width)}")
    wrong = labels[labels != labels.astype(dtype)]
    if wrong.size:
        raise ValueError(f"label id {wrong[0]}; the file takes {dtype}")
    name, count = ("logits", space.channel_counts[-1]) if channels else ("labels", 0)
    return np.concatenate([as_input(labels[None], count, name, dtype.name)] * (batch or 1))
