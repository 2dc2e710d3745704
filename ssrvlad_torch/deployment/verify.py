"""Verify: an exported or fused ONNX file against the PyTorch module."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..config import SSRVLADConfig
from ..datasets.label_files import LabelFile, LabelMap, read_label_map
from ..descriptor import SSRVLAD, SweepHead
from ..files import one_line
from ..onnx_files import CPU, graph_digest, load_model, open_session
from ..taxonomy import LabelSpace
from ..untrusted import parse_json
from .fuse import (
    HEAD,
    HEAD_GOLDEN,
    IMAGE,
    LABELS,
    MOST_OTHER_PIXELS,
    NETWORK,
    OUTPUTS,
    FusedNetwork,
    described,
    run_by_name,
)
from .metadata import PREFIX, SEAL, Metadata, seal

if TYPE_CHECKING:
    import onnx

Arrays = Mapping[str, npt.NDArray[Any]]

TOLERANCE = 1e-6
"""Largest difference of a number of a descriptor; counts must be equal."""


class Check(NamedTuple):
    """One comparison.

    Attributes:
        name: what was compared: ``"golden pair"``, ``"module"``, ``"golden image"``, or the id of
            a frame.
        difference: the largest between two descriptors; NaN and another shape count as infinite.
        problem: what is wrong, or ``""``.
    """

    name: str
    difference: float
    problem: str


@dataclass(frozen=True)
class Verification:
    """What was found out about a file.

    Attributes:
        version: of the package that wrote it.
        fingerprint, labels_as: of its settings.
        network: name of the file of the network in it, ``None`` for the head alone.
        warnings: what is odd about it but no fault.
        problems: what is wrong with it as a whole.
        checks: the comparisons.
        skipped: frames that could not be compared, and why.
    """

    version: str
    fingerprint: str
    labels_as: str
    network: str | None
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    skipped: list[tuple[str, str]] = field(default_factory=list)

    @property
    def difference(self) -> float:
        """The largest between two descriptors."""
        return max((check.difference for check in self.checks), default=0.0)

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems and not any(check.problem for check in self.checks)


def verify(
    path: str | Path,
    labels: Sequence[LabelFile] = (),
    provider: str = CPU,
    progress: Callable[[int], None] | None = None,
) -> Verification:
    """Runs a file of `export_head` or `fuse` in ONNX Runtime and compares.

    The head is run on its golden pair, as is the module; then on the label maps, each against the
    module. Of a fused file the head is cut out for this, and the whole is run on its golden
    image: at most 1 % of the pixels may get another label than was recorded, for a network is not
    computed alike everywhere, and the head must agree with the module on the labels it was given.

    Args:
        path: the file.
        labels: label maps in the file's label space. A file that takes class scores is given 1
            for a pixel's class and 0 for others; an id without scores is 0 everywhere.
        provider: execution provider of ONNX Runtime.
        progress: called with the number of frames done since the last call.

    Raises:
        ValueError: the file is damaged, is none of `export_head` and `fuse`, was written by a
            version with other settings, or cannot be run.
        ImportError: the extra ``onnx`` is not installed.
    """
    path = Path(path)
    model = load_model(path)
    try:
        return _verify(path, model, labels, provider, progress)
    except ImportError:
        raise
    except Exception as error:  # metadata and graphs can be wrong in any way
        reason = f"metadata lacks {error}" if isinstance(error, KeyError) else one_line(error)
        named = reason.startswith(str(path))
        raise ValueError(reason if named else f"{path}: {reason}") from error


def _verify(
    path: Path,
    model: onnx.ModelProto,
    labels: Sequence[LabelFile],
    provider: str,
    progress: Callable[[int], None] | None,
) -> Verification:
    properties = {entry.key: entry.value for entry in model.metadata_props}
    metadata = Metadata.from_properties(properties)
    config = _config(metadata)
    network = properties.get(NETWORK)
    fused = FusedNetwork(**parse_json(network, NETWORK)) if network else None
    found = Verification(
        metadata.version,
        metadata.fingerprint,
        metadata.label_space["name"],
        fused.name if fused else None,
    )
    _compare_words(found, metadata, config, properties, model)
    head = _module(config, metadata)
    golden = metadata.golden_arrays()
    if fused:
        whole = open_session(path, path, provider)
        alone = parse_json(properties[HEAD_GOLDEN], HEAD_GOLDEN)
        found.checks.append(_check_whole(whole, golden, head))
        golden = replace(metadata, golden=alone).golden_arrays()
        model = cut_head(model)
    run = _Head(open_session(model.SerializeToString(), path, provider), head)
    found.checks.extend(_check_golden(run, golden))
    for file in labels:
        _check_frame(found, run, file)
        if progress:
            progress(1)
    return found


def cut_head(model: onnx.ModelProto) -> onnx.ModelProto:
    """The head of a fused file alone: labels in, ``descriptor``, ``keypoints``, ``unknown`` out.

    `onnx.utils.Extractor` leaves out what a loop takes from outside; the names tell.
    """
    from onnx import helper

    nodes = [node for node in model.graph.node if node.name.startswith(HEAD)]
    tables = [tensor for tensor in model.graph.initializer if tensor.name.startswith(HEAD)]
    inputs = [value for value in model.graph.output if value.name == LABELS]
    outputs = [value for value in model.graph.output if value.name in OUTPUTS]
    graph = helper.make_graph(nodes, "ssrvlad", inputs, outputs, tables)
    return helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)


class _Head:
    """The head of a file, and the module that it is compared with."""

    def __init__(self, session: Any, module: SSRVLAD) -> None:
        self.session = session
        self.module = module
        (self.input,) = session.get_inputs()
        self.outputs = [value.name for value in session.get_outputs()]
        if len(self.outputs) != len(OUTPUTS):
            raise ValueError(f"gives {', '.join(self.outputs)}; expected {', '.join(OUTPUTS)}")

    def run(self, given: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
        found = self.session.run(None, {self.input.name: given})
        return dict(zip(OUTPUTS, found, strict=True))

    def form_of(self, labels: LabelMap) -> npt.NDArray[Any]:
        """A label map as the head takes it: ``(1, H, W)`` ids or ``(1, C, H, W)`` scores.

        Raises:
            ValueError: an id that its input cannot hold.
        """
        if self.input.type == "tensor(float)":
            ids = np.arange(self.module.label_space.channel_counts[-1])
            return np.equal(labels, ids[:, None, None])[None].astype(np.float32)
        if self.input.type == "tensor(uint8)" and (labels.min() < 0 or labels.max() > 255):
            wrong = labels.min() if labels.min() < 0 else labels.max()
            raise ValueError(f"label id {wrong} is no uint8, which the file takes")
        return labels[None].astype(np.uint8 if "uint8" in self.input.type else np.int64)


def _check_golden(head: _Head, golden: dict[str, npt.NDArray[Any]]) -> list[Check]:
    """The file, and the module of this version, against what was recorded."""
    (name,) = golden.keys() - {*OUTPUTS}
    given = golden.pop(name)
    return [
        compare("golden pair", head.run(given), golden),
        compare("module", described(head.module, given), golden),
    ]


def _check_whole(session: Any, golden: Arrays, head: SSRVLAD) -> Check:
    """The whole of a fused file on its golden image."""
    outputs = run_by_name(session, {IMAGE: golden[IMAGE]})
    labels, recorded = outputs[LABELS], golden[LABELS]
    check = compare("golden image", outputs, described(head, labels))
    if labels.shape != recorded.shape:
        return check._replace(problem=f"labels are {labels.shape}, not {recorded.shape}")
    fraction = float((labels != recorded).mean())
    if fraction > MOST_OTHER_PIXELS:
        return check._replace(problem=f"{fraction:.1%} of the pixels have another label")
    if fraction == 0 and not check.problem:
        return compare("golden image", outputs, golden)
    return check


def _check_frame(found: Verification, head: _Head, file: LabelFile) -> None:
    try:
        given = head.form_of(read_label_map(file, head.module.label_space))
        expected = described(head.module, given)
    except ValueError as error:
        found.skipped.append((file.frame, str(error)))
        return
    found.checks.append(compare(file.frame, head.run(given), expected))


def compare(name: str, got: Arrays, expected: Arrays) -> Check:
    """Outputs against what they are to be: counts equal, descriptors within `TOLERANCE`."""
    for output in OUTPUTS:
        if got[output].shape != expected[output].shape:
            shapes = f"{got[output].shape}, not {expected[output].shape}"
            return Check(name, np.inf, f"{output} is {shapes}")
    steps = np.abs(got["descriptor"].astype(np.float64) - expected["descriptor"])
    difference = float(np.nan_to_num(steps, nan=np.inf).max(initial=0))
    other = [output for output in OUTPUTS[1:] if not np.array_equal(got[output], expected[output])]
    problems = [f"{output} differ" for output in other]
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
