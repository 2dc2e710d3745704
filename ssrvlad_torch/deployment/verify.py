"""Verify: compares an exported or fused ONNX file on a runtime with the PyTorch module."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..config import SSRVLADConfig, package_version
from ..datasets.frame_file import FrameFile, Skipped
from ..datasets.label_files import LabelMap, read_label_map
from ..descriptor import SSRVLAD
from ..encoding.results import Progress, do_nothing
from ..files import one_line, parse_json
from ..segmentation.onnx_files import CPU, load_model
from ..segmentation.openvino_session import SINGLE
from ..taxonomy import LabelSpace
from .fuse import HEAD, IMAGE, LABELS, NETWORK, OF_PICTURES, FusedNetwork, problem_of_network
from .golden import as_input, outputs_of
from .metadata import PREFIX, Arrays, Metadata
from .runtimes import Run, Runtime, runtime_of

if TYPE_CHECKING:
    import onnx

TOLERANCE = 1e-6
"""Largest difference of a number of a descriptor. Counts must be equal."""

CANNOT = "cannot run"


@dataclass(frozen=True)
class Check:
    """One comparison.

    Attributes:
        name: ``"golden pair"``, ``"golden image"``, or a frame's id.
        difference: largest difference of two descriptors; infinite for NaN or another shape.
        problem: what is wrong, or ``""``.
    """

    name: str
    difference: float
    problem: str


@dataclass
class Verification:
    """The result of `verify`.

    Attributes:
        runtime: name and version of the runtime.
        version: version of the package that wrote the file.
        fingerprint, labels_as: fingerprint and label space of the settings in the file.
        network: name of the network in the file, ``None`` for a head alone.
        channels: fingerprints of the channels of pictures that the file gives, by name.
        warnings: remarks that are no problems.
        problems: problems of the file as a whole.
        checks: the comparisons.
        skipped: frames that could not be compared.
        by_default: of OpenVINO, the golden pair without settings; no part of the verdict.
        verdict: ``"exact"``, ``"wrong"`` or ``"cannot run"``: how the runtime computes this file.
    """

    runtime: str
    version: str
    fingerprint: str
    labels_as: str
    network: str | None
    channels: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    by_default: Check | None = None
    verdict: str = "exact"

    def add(self, check: Check) -> None:
        """Adds a comparison, and what it says of the runtime."""
        self.checks.append(check)
        if check.problem and self.verdict == "exact":
            self.verdict = "cannot run" if check.problem.startswith(CANNOT) else "wrong"

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
    """Compares a file of `export_head` or `fuse` on a runtime with the module.

    The file runs on its golden pair; its head runs on `labels`, and is compared with the module on
    each. Of a fused file, the head is extracted for this, and on the golden image at most 1 % of
    the pixels may have another label than the recorded one, and at most 1 % of the signs of its
    features be others, because runtimes compute networks differently; its HOG and the head on these
    labels must agree with the module. Of a network without a head, the rest is compared.

    Args:
        path: the file.
        labels: label maps in the file's label space. For a file that takes class scores, the score
            is 1 for a pixel's class and 0 for others; for an id without scores all are 0.
        provider: execution provider of ONNX Runtime, or ``"openvino"``.
        progress: is called with the number of frames done since the last call.

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
    metadata = Metadata.from_properties(properties)
    module = _module(metadata)
    text = properties.get(NETWORK)
    fused = FusedNetwork(**parse_json(text, NETWORK)) if text else None
    result = _begun(metadata, module, fused, runtime, path)
    golden = metadata.golden_arrays()
    result.problems += _problems_of_channels(properties, golden, fused.channels if fused else {})
    if fused:
        judge = partial(_judge_image, golden=golden, module=module)
        image = {IMAGE: golden[IMAGE]}
        result.add(_File(runtime, path).check("golden image", image, judge))
        if "descriptor" not in golden:
            return result
        model = _head_of(model)
    head = _File(runtime, model.SerializeToString() if fused else path)
    value = model.graph.input[0]
    given = {value.name: golden.pop(value.name)}
    expected = {name: golden[name] for name in golden if name not in (IMAGE, *OF_PICTURES)}
    judge_pair = partial(compare, expected=expected or outputs_of(module, given[value.name]))
    if runtime.plain:
        plain = _File(runtime.plain, model.SerializeToString())
        check = plain.check(f"golden pair, {runtime.plain.name}", given, judge_pair)
        result.by_default = check
        if check.problem:
            result.warnings.append(
                f"wrong in {runtime.plain.name}: {check.problem}; expected "
                f"compile_model(model, 'CPU', {SINGLE})"
            )
    if not fused:
        result.add(head.check("golden pair", given, judge_pair))
    for frame in labels:
        _check_frame(result, head, value, module, frame)
        progress(1)
    return result


def _problems_of_channels(
    properties: Mapping[str, str], golden: Arrays, own: Mapping[str, str]
) -> Iterator[str]:
    """Where the channels of pictures that a file names, and its golden arrays, are not those that
    its network has."""
    for name in OF_PICTURES:
        named = properties.get(PREFIX + name, "") == own.get(name, "")
        if not named or (name in golden) != (name in own):
            yield f"{name}: not what the properties {PREFIX}{name} and {NETWORK} name"


def _judge_image(name: str, got: Arrays, golden: Arrays, module: SSRVLAD) -> Check:
    """Compares the outputs of the golden image with the recorded ones, and its descriptor with that
    of the labels that the runtime gives it."""
    if problem := problem_of_network(got, golden):
        return Check(name, np.inf, problem)
    return compare(name, got, outputs_of(module, got[LABELS]) if "descriptor" in golden else {})


def _begun(
    metadata: Metadata, module: SSRVLAD, fused: FusedNetwork | None, runtime: Runtime, path: Path
) -> Verification:
    """What is known of a file before it runs."""
    result = Verification(
        runtime.name,
        metadata.version,
        metadata.fingerprint,
        metadata.label_space["name"],
        fused.name if fused else None,
        fused.channels if fused else {},
    )
    if metadata.version != package_version():
        result.warnings.append(
            f"written by version {metadata.version} of ssrvlad_torch, this is {package_version()}"
        )
    if module.config.fingerprint != metadata.fingerprint:
        result.problems.append(
            f"fingerprint {metadata.fingerprint} is not that of its settings in this version, "
            f"{module.config.fingerprint}"
        )
    result.warnings.extend(filter(None, [runtime.cpu_fallback(path)]))
    return result


def _head_of(model: onnx.ModelProto) -> onnx.ModelProto:
    """The head in a fused file, by the prefix of its names.

    `onnx.utils.Extractor` misses the outer values that a loop body uses.
    """
    from onnx import helper

    nodes = [node for node in model.graph.node if node.name.startswith(HEAD)]
    tables = [tensor for tensor in model.graph.initializer if tensor.name.startswith(HEAD)]
    inputs = [value for value in model.graph.output if value.name == LABELS]
    others = (LABELS, *OF_PICTURES)
    outputs = [value for value in model.graph.output if value.name not in others]
    graph = helper.make_graph(nodes, "ssrvlad", inputs, outputs, tables)
    return helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)


class _File:
    """A file on a runtime, opened once. On ONNX Runtime on the CPU an error is raised; on other
    runtimes it is the problem of a check."""

    def __init__(self, runtime: Runtime, source: Path | bytes) -> None:
        self.runtime, self.source = runtime, source
        self.run: Run | None = None

    def check(self, name: str, inputs: Arrays, judge: Callable[[str, Arrays], Check]) -> Check:
        """Runs the file on inputs and judges the outputs."""
        try:
            self.run = self.run or self.runtime.open(self.source)
            outputs = self.run(inputs)
        except Exception as error:  # runtimes have no common error type
            if self.runtime.provider == CPU:
                raise
            return Check(name, np.inf, f"{CANNOT}: {one_line(error)}")
        return judge(name, outputs)


def _check_frame(
    result: Verification, head: _File, value: onnx.ValueInfoProto, module: SSRVLAD, file: FrameFile
) -> None:
    """Compares a head with this input and the module on a label map that the input can hold."""
    space = module.label_space
    try:
        array = _input_of(read_label_map(file, space), value, space)
        expected = outputs_of(module, array)
        if expected["unknown"].any():
            module(array)  # raises an error that names the ids
    except ValueError as error:
        result.skipped.append(Skipped(file.frame, str(error)))
        return
    result.add(head.check(file.frame, {value.name: array}, partial(compare, expected=expected)))


def _input_of(labels: LabelMap, value: onnx.ValueInfoProto, space: LabelSpace) -> npt.NDArray[Any]:
    """``(B, H, W)`` ids or ``(B, C, H, W)`` scores of a label map. An id that the input cannot
    hold, and another size than a fixed one, are a ValueError."""
    from onnx import helper

    kind = value.type.tensor_type
    dtype = helper.tensor_dtype_to_np_dtype(kind.elem_type).name
    batch, *channels, height, width = (axis.dim_value for axis in kind.shape.dim)
    if height and width and labels.shape != (height, width):
        raise ValueError(f"a label map of {labels.shape}; the file takes {(height, width)}")
    if dtype == "uint8" and (labels.min() < 0 or labels.max() > 255):
        wrong = labels.min() if labels.min() < 0 else labels.max()
        raise ValueError(f"label id {wrong}; the file takes uint8")
    name, count = ("logits", space.channel_counts[-1]) if channels else ("labels", 0)
    return np.concatenate([as_input(labels[None], count, name, dtype)] * (batch or 1))


def compare(name: str, got: Arrays, expected: Arrays) -> Check:
    """Compares outputs by name: counts must be equal, descriptors agree within `TOLERANCE`."""
    for output in expected:
        if got[output].shape != expected[output].shape:
            shapes = f"{got[output].shape}, not {expected[output].shape}"
            return Check(name, np.inf, f"{output} is {shapes}")
    if "descriptor" not in expected:
        return Check(name, 0.0, "")
    steps = np.abs(got["descriptor"].astype(np.float64) - expected["descriptor"])
    difference = float(np.nan_to_num(steps, nan=np.inf).max(initial=0))
    counts = [output for output in expected if output != "descriptor"]
    problems = [f"{name} differ" for name in counts if (got[name] != expected[name]).any()]
    if difference > TOLERANCE:
        problems.insert(0, f"descriptors differ by {difference:.2g}")
    return Check(name, difference, ", ".join(problems))


def _module(metadata: Metadata) -> SSRVLAD:
    try:
        config = SSRVLADConfig.from_dict(metadata.config)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"settings of version {metadata.version} do not fit {package_version()}: {error}"
        ) from error
    space = LabelSpace.from_dict({"source": PREFIX, **metadata.label_space})
    return SSRVLAD(replace(config, labels_as=space), metadata.interface.get("sweep", ()))
