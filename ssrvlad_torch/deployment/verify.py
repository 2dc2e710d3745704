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
from ..files import naming, one_line
from ..segmentation.onnx_files import CPU, load_model
from ..taxonomy import LabelSpace
from .differences import IMAGE, LABELS, difference_of, problem_of_network
from .fuse import head_of, network_in
from .golden import as_input, outputs_of
from .metadata import PREFIX, Arrays, Metadata
from .runtimes import runtime_of

if TYPE_CHECKING:
    import onnx

CANNOT = "cannot run"
Judge = Callable[[Arrays], tuple[float, str]]


class Check(NamedTuple):
    """A comparison: a frame's id, ``"golden pair"``, ``"golden image"`` or ``"fingerprint"``; the
    largest difference of two descriptors, infinite for NaN or another shape; what is wrong, or
    ``""``."""

    name: str
    difference: float
    problem: str


@dataclass
class Verification:
    """What runs the file; its version, fingerprint, label space, network (``None`` for a head
    alone), and fingerprints of channels; comparisons; and frames that were not compared."""

    runtime: str
    version: str
    fingerprint: str
    labels_as: str
    network: str | None = None
    channels: dict[str, str] = field(default_factory=dict)
    checks: list[Check] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """How the runtime computes the file: ``"exact"``, ``"wrong"`` or ``"cannot run"``."""
        problem = next((check.problem for check in self.checks if check.problem), "")
        return (CANNOT if problem.startswith(CANNOT) else "wrong") if problem else "exact"

    @property
    def difference(self) -> float:
        """Largest difference of two descriptors."""
        return max((check.difference for check in self.checks), default=0.0)

    @property
    def passed(self) -> bool:
        """Whether the runtime computes the file exactly."""
        return self.verdict == "exact"


def verify(
    path: str | Path,
    labels: Sequence[FrameFile] = (),
    provider: str = CPU,
    progress: Progress = do_nothing,
) -> Verification:
    """Compares a file of `export_head` or `fuse` on a runtime, a provider of ONNX Runtime or
    ``"openvino"``, with the module: on its golden pair or image, of which 1 % of the labels and of
    the signs of features may differ, and its head on label maps. A damaged or other file, and one
    that cannot run in ONNX Runtime on the CPU, are a ValueError; no runtime is an ImportError."""
    path, runtime = Path(path), runtime_of(provider)
    model, open_graph = load_model(path), cache(runtime.open)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    with naming(path):
        metadata, network = Metadata.from_properties(properties), network_in(properties)
        space = LabelSpace.from_dict({"source": PREFIX, **metadata.label_space})
        config = replace(SSRVLADConfig.from_dict(metadata.config), labels_as=space)
        module = SSRVLAD(config, metadata.interface.get("sweep", ()))
        golden = metadata.golden_arrays()
        result = Verification(runtime.name, metadata.version, metadata.fingerprint, space.name)

        def check(name: str, source: Path | bytes, inputs: Arrays, judge: Judge) -> None:
            """Notes what is wrong with the outputs for some inputs, also if the runtime fails."""
            try:
                result.checks.append(Check(name, *judge(open_graph(source)(inputs))))
            except Exception as error:  # runtimes have no common error type
                if provider == CPU:
                    raise
                result.checks.append(Check(name, np.inf, f"{CANNOT}: {one_line(error)}"))

        def of_image(outputs: Arrays) -> tuple[float, str]:
            if problem := problem_of_network(outputs, golden):
                return np.inf, problem
            expected = outputs_of(module, outputs[LABELS]) if "descriptor" in golden else {}
            return difference_of(outputs, expected)

        if config.fingerprint != metadata.fingerprint:
            problem = (
                f"fingerprint {metadata.fingerprint} is not that of its settings in this version, "
                f"{config.fingerprint}"
            )
            result.checks.append(Check("fingerprint", 0.0, problem))
        source: Path | bytes = path
        name = IMAGE if network else model.graph.input[0].name
        array = golden.pop(name)
        if network:
            result.network, result.channels = network.name, network.channels
            check("golden image", path, {name: array}, of_image)
            if "descriptor" not in golden:
                return result
            model = head_of(model)
            source = model.SerializeToString()
        else:
            expected = golden or outputs_of(module, array)
            check("golden pair", path, {name: array}, partial(difference_of, expected=expected))
        value = model.graph.input[0]
        for frame in labels:
            try:
                array = _input_of(read_label_map(frame, space), value, space)
                outputs = outputs_of(module, array)
                if outputs["unknown"].any():
                    module(array)  # raises an error that names the ids
            except ValueError as error:
                result.skipped.append(Skipped(frame.frame, str(error)))
            else:
                judge = partial(difference_of, expected=outputs)
                check(frame.frame, source, {value.name: array}, judge)
            progress(1)
    return result


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
