"""Verify: an exported or fused ONNX file, on a runtime, against the PyTorch module."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..config import SSRVLADConfig
from ..datasets.frame_files import FrameFile
from ..datasets.label_files import LabelMap, read_label_map
from ..descriptor import SSRVLAD, SweepHead
from ..files import one_line
from ..onnx_files import CPU, graph_digest, load_model
from ..taxonomy import LabelSpace
from ..untrusted import parse_json
from .diagnosis import Fault, diagnose
from .fuse import HEAD, HEAD_GOLDEN, IMAGE, LABELS, MOST_OTHER_PIXELS, NETWORK, FusedNetwork
from .golden import CORPUS_SIZES, as_input, corpus, outputs_of
from .metadata import PREFIX, SEAL, Metadata, seal
from .runtimes import Arrays, Run, Runtime, runtime_of

if TYPE_CHECKING:
    import onnx

TOLERANCE = 1e-6
"""Largest difference of a number of a descriptor; counts must be equal."""


class Check(NamedTuple):
    """One comparison.

    Attributes:
        name: what was compared: ``"golden pair"``, ``"module"``, ``"golden image"``, a map of the
            corpus, or the id of a frame.
        difference: the largest between two descriptors; NaN and another shape count as infinite.
        problem: what is wrong, or ``""``.
    """

    name: str
    difference: float
    problem: str


@dataclass
class Verification:
    """What was found out about a file on a runtime.

    Attributes:
        runtime: with its version.
        version: of the package that wrote the file.
        fingerprint, labels_as: of its settings.
        network: name of the file of the network in it, ``None`` for the head alone.
        warnings: what is odd about it but no fault.
        problems: what is wrong with it as a whole.
        checks: the comparisons.
        skipped: frames that could not be compared, and why.
        fault: where another runtime than ONNX Runtime on the CPU goes wrong.
    """

    runtime: str
    version: str
    fingerprint: str
    labels_as: str
    network: str | None
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    fault: Fault | None = None

    @property
    def difference(self) -> float:
        """The largest between two descriptors."""
        return max((check.difference for check in self.checks), default=0.0)

    @property
    def verdict(self) -> str:
        """``"exact"``, ``"wrong"`` or ``"cannot run"``: of the runtime with this file."""
        if self.fault:
            return self.fault.kind
        return "wrong" if any(check.problem for check in self.checks) else "exact"

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong, with the file or the runtime."""
        return not self.problems and self.verdict == "exact"


def verify(
    path: str | Path,
    labels: Sequence[FrameFile] = (),
    provider: str = CPU,
    progress: Callable[[int], None] | None = None,
) -> Verification:
    """Runs a file of `export_head` or `fuse` on a runtime and compares.

    The head is run on its golden pair, as is the module; then on the maps of the `corpus` and on
    the label maps given, each against the module. Of a fused file the head is cut out for this,
    and the whole is run on its golden image: at most 1 % of the pixels may get another label than
    was recorded, for a network is not computed alike everywhere, and the head must agree with the
    module on the labels it was given. Of a network that was split off its labels are compared.

    Where another runtime than ONNX Runtime on the CPU fails, ``fault`` says at which node, and
    where it gives other numbers, after which stage of the graph they differ first.

    Args:
        path: the file.
        labels: label maps in the file's label space. A file that takes class scores is given 1
            for a pixel's class and 0 for others; an id without scores is 0 everywhere.
        provider: execution provider of ONNX Runtime, or ``"openvino"``.
        progress: called with the number of frames done since the last call.

    Raises:
        ValueError: the file is damaged, is none of `export_head` and `fuse`, was written by a
            version with other settings, or cannot be run by ONNX Runtime on the CPU.
        ImportError: the runtime is not installed.
    """
    path = Path(path)
    model = load_model(path)
    try:
        return _verify(path, model, labels, runtime_of(provider), progress)
    except ImportError:
        raise
    except Exception as error:  # metadata and graphs can be wrong in any way
        reason = f"metadata lacks {error}" if isinstance(error, KeyError) else one_line(error)
        named = reason.startswith(str(path))
        raise ValueError(reason if named else f"{path}: {reason}") from error


def _verify(
    path: Path,
    model: onnx.ModelProto,
    labels: Sequence[FrameFile],
    runtime: Runtime,
    progress: Callable[[int], None] | None,
) -> Verification:
    properties = {entry.key: entry.value for entry in model.metadata_props}
    metadata = Metadata.from_properties(properties)
    config = _config(metadata)
    network = properties.get(NETWORK)
    fused = FusedNetwork(**parse_json(network, NETWORK)) if network else None
    found = Verification(
        runtime.name,
        metadata.version,
        metadata.fingerprint,
        metadata.label_space["name"],
        fused.name if fused else None,
    )
    _compare_words(found, metadata, config, properties, model)
    found.warnings.extend(filter(None, [runtime.elsewhere(path)]))
    module = _module(config, metadata)
    golden, faults = metadata.golden_arrays(), []
    if fused:
        whole = _Runner(model, path, runtime)
        found.checks.append(_check_whole(whole, golden, module))
        faults.append(whole.fault)
        if HEAD_GOLDEN not in properties:
            found.fault = whole.fault
            return found
        alone = parse_json(properties[HEAD_GOLDEN], HEAD_GOLDEN)
        golden = replace(metadata, golden=alone).golden_arrays()
        model = cut_head(model)
    runner = _Runner(model, model.SerializeToString(), runtime)
    head = _Head(runner, module, model.graph.input[0])
    found.checks.extend(_check_golden(head, golden))
    found.checks.append(_check_corpus(head))
    for file in labels:
        _check_frame(found, head, file)
        if progress:
            progress(1)
    found.fault = next(filter(None, [runner.fault, *faults]), None)
    return found


def cut_head(model: onnx.ModelProto) -> onnx.ModelProto:
    """The head of a fused file alone.

    `onnx.utils.Extractor` leaves out what a loop takes from outside; the names tell.
    """
    from onnx import helper

    nodes = [node for node in model.graph.node if node.name.startswith(HEAD)]
    tables = [tensor for tensor in model.graph.initializer if tensor.name.startswith(HEAD)]
    inputs = [value for value in model.graph.output if value.name == LABELS]
    outputs = [value for value in model.graph.output if value.name != LABELS]
    graph = helper.make_graph(nodes, "ssrvlad", inputs, outputs, tables)
    return helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)


class _Runner:
    """A graph on a runtime.

    Attributes:
        fault: where the runtime went wrong first, if it is not the one that it is compared with.
    """

    def __init__(self, model: onnx.ModelProto, source: Path | bytes, runtime: Runtime) -> None:
        self.fault: Fault | None = None
        self._model, self._runtime = model, runtime
        self._run = _opened(runtime, source)

    def check(self, name: str, given: Arrays, judge: Callable[[Arrays], Check]) -> Check:
        """What is said of the outputs for an input; a runtime that fails is a problem."""
        try:
            check = judge(self._run(given))
        except Exception as error:  # what runtimes raise has no common base
            if self._runtime.is_reference:
                raise
            check = Check(name, np.inf, f"cannot run: {one_line(error)}")
        if check.problem and not self.fault and not self._runtime.is_reference:
            self.fault = diagnose(self._model, given, self._runtime)
        return check


def _opened(runtime: Runtime, source: Path | bytes) -> Run:
    """A file on a runtime; if it cannot be opened, a function that says so."""
    try:
        return runtime.open(source)
    except Exception as error:  # as above
        reason = error

    def fail(_: Arrays) -> dict[str, npt.NDArray[Any]]:
        raise reason

    return fail


class _Head:
    """A head on a runtime, and the module that it is compared with."""

    def __init__(self, runner: _Runner, module: SSRVLAD, given: onnx.ValueInfoProto) -> None:
        from onnx import helper

        kind = given.type.tensor_type
        self.runner, self.module, self.input = runner, module, given.name
        self.scores = len(kind.shape.dim) == 4
        self.dtype = helper.tensor_dtype_to_np_dtype(kind.elem_type).name
        self.batch = kind.shape.dim[0].dim_value or 1
        height, width = (axis.dim_value for axis in kind.shape.dim[-2:])
        self.size = (height, width) if height and width else None

    def check(self, name: str, given: npt.NDArray[Any], expected: Arrays | None = None) -> Check:
        """The outputs for an input against the module's, or against what was recorded."""
        wanted = expected or outputs_of(self.module, given)
        return self.runner.check(name, {self.input: given}, lambda got: compare(name, got, wanted))

    def corpus(self) -> Iterator[tuple[str, npt.NDArray[Any]]]:
        """Names and inputs of the maps on which every file is compared."""
        kind = "logits" if self.scores else "labels"
        sizes = (self.size,) * 3 if self.size else CORPUS_SIZES
        for name, given in corpus(self.module, kind, self.dtype, sizes):
            yield name, np.concatenate([given] * self.batch)

    def form_of(self, labels: LabelMap) -> npt.NDArray[Any]:
        """A label map as the head takes it: ``(B, H, W)`` ids or ``(B, C, H, W)`` scores.

        Raises:
            ValueError: an id that its input cannot hold, or another size than it takes.
        """
        if self.size not in (None, labels.shape):
            raise ValueError(f"a label map of {labels.shape}; the file takes {self.size}")
        if self.dtype == "uint8" and (labels.min() < 0 or labels.max() > 255):
            wrong = labels.min() if labels.min() < 0 else labels.max()
            raise ValueError(f"label id {wrong} is no uint8, which the file takes")
        channels = self.module.label_space.channel_counts[-1] if self.scores else 0
        kind = "logits" if self.scores else "labels"
        given = as_input(labels[None], channels, kind, self.dtype)
        return np.concatenate([given] * self.batch)


def _check_golden(head: _Head, golden: dict[str, npt.NDArray[Any]]) -> list[Check]:
    """The file, and the module of this version, against what was recorded."""
    given = golden.pop(head.input if head.input in golden else LABELS)
    return [
        head.check("golden pair", given, golden),
        compare("module", outputs_of(head.module, given), golden),
    ]


def _check_corpus(head: _Head) -> Check:
    """All maps of the corpus as one comparison."""
    checks = [head.check(name, given) for name, given in head.corpus()]
    wrong = [check for check in checks if check.problem]
    problem = f"{len(wrong)} of {len(checks)} maps, " if wrong else ""
    problem += "; ".join(f"{check.name}: {check.problem}" for check in wrong[:1])
    return Check("corpus", max(check.difference for check in checks), problem)


def _check_whole(runner: _Runner, golden: Arrays, module: SSRVLAD) -> Check:
    """The whole of a fused file on its golden image, or the network of one that was split."""
    expected = {name: array for name, array in golden.items() if name != IMAGE}
    has_head = "descriptor" in expected

    def judge(got: Arrays) -> Check:
        labels, recorded = got[LABELS], expected[LABELS]
        check = Check("golden image", 0.0, "")
        if has_head:
            check = compare("golden image", got, outputs_of(module, labels))
        if labels.shape != recorded.shape:
            return check._replace(problem=f"labels are {labels.shape}, not {recorded.shape}")
        fraction = float((labels != recorded).mean())
        if fraction > MOST_OTHER_PIXELS:
            return check._replace(problem=f"{fraction:.1%} of the pixels have another label")
        if fraction == 0 and has_head and not check.problem:
            return compare("golden image", got, expected)
        return check

    return runner.check("golden image", {IMAGE: golden[IMAGE]}, judge)


def _check_frame(found: Verification, head: _Head, file: FrameFile) -> None:
    try:
        given = head.form_of(read_label_map(file, head.module.label_space))
        expected = outputs_of(head.module, given)
        if expected["unknown"].any():
            head.module(given)  # raises what names the ids
    except ValueError as error:
        found.skipped.append((file.frame, str(error)))
        return
    found.checks.append(head.check(file.frame, given, expected))


def compare(name: str, got: Arrays, expected: Arrays) -> Check:
    """Outputs against what they are to be: counts equal, descriptors within `TOLERANCE`."""
    for output in expected:
        if got[output].shape != expected[output].shape:
            shapes = f"{got[output].shape}, not {expected[output].shape}"
            return Check(name, np.inf, f"{output} is {shapes}")
    steps = np.abs(got["descriptor"].astype(np.float64) - expected["descriptor"])
    difference = float(np.nan_to_num(steps, nan=np.inf).max(initial=0))
    counts = [output for output in expected if output != "descriptor"]
    problems = [f"{name} differ" for name in counts if (got[name] != expected[name]).any()]
    if difference > TOLERANCE:
        problems.insert(0, f"descriptors differ by {difference:.2g}")
    return Check(name, difference, ", ".join(problems))


def _compare_words(
    found: Verification,
    metadata: Metadata,
    config: SSRVLADConfig,
    properties: Mapping[str, str],
    model: onnx.ModelProto,
) -> None:
    """What the file says about itself against what it is."""
    if metadata.version != __version__:
        found.warnings.append(
            f"written by version {metadata.version} of ssrvlad_torch, this is {__version__}"
        )
    if properties.get(SEAL) != seal(graph_digest(model), properties):
        found.problems.append("the graph or its metadata was edited after it was written")
    if config.fingerprint != metadata.fingerprint:
        found.problems.append(
            f"fingerprint {metadata.fingerprint} is not that of its settings in this version, "
            f"{config.fingerprint}"
        )


def _config(metadata: Metadata) -> SSRVLADConfig:
    try:
        return SSRVLADConfig.from_dict(metadata.config)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"the settings of version {metadata.version} are not those of {__version__}: {error}"
        ) from error


def _module(config: SSRVLADConfig, metadata: Metadata) -> SSRVLAD:
    """The module with the label space that the file holds, wherever it came from."""
    space = LabelSpace.from_dict({"source": PREFIX, **metadata.label_space})
    given, columns = replace(config, labels_as=space), metadata.interface.get("sweep")
    return SweepHead(given, columns) if columns else SSRVLAD(given)
