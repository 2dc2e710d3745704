"""Fuse: a segmentation network and the head in one ONNX file, from pixels to place."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from .export import head_model
from .golden_image import run_on_golden_image
from .graph import OPSET
from .label_output import LabelOutput, find_label_output
from .metadata import PREFIX, Metadata
from .model_file import (
    graph_digest,
    load_model,
    names_of,
    one_line,
    open_session,
    rename,
    save_model,
)

if TYPE_CHECKING:
    import onnx

Arrays = Mapping[str, npt.NDArray[Any]]

DIGEST = f"{PREFIX}graph_sha256"
NETWORK = f"{PREFIX}network"
HEAD_GOLDEN = f"{PREFIX}head_golden"

MOST_OTHER_PIXELS = 0.01
"""Share of a golden image's pixels that may get another label where the network is computed in
another order: after a change of opset, or on another processor."""

_ONNX_DOMAINS = ("", "ai.onnx")


@dataclass(frozen=True)
class FusedNetwork:
    """What a fused file says about the network in it.

    Attributes:
        name: of the file that it came from.
        sha256: of that file, without weights that lay beside it.
        output: the output that the head takes.
        kind, axis, dtype: see `LabelOutput`.
        prefix: of all names that are not the network's own.
        heads: names of the outputs ``descriptor``, ``keypoints`` and ``unknown``.
    """

    name: str
    sha256: str
    output: str
    kind: str
    axis: int | None
    dtype: str
    prefix: str
    heads: dict[str, str]

    def label_output(self) -> LabelOutput:
        """The output that the head takes."""
        return LabelOutput(self.output, self.kind, self.axis, self.dtype)


def fuse(
    network: str | Path, config: SSRVLADConfig, path: str | Path, output: str | None = None
) -> FusedNetwork:
    """Joins a segmentation graph and the head in one ONNX file that runs on the CPU in ONNX
    Runtime with nothing else.

    The head takes the label of the largest score at the output's own stride: the scores are not
    enlarged, since the working grid is smaller than most outputs. So the paper's preset, which
    has no working grid, works at the size of the output, not of the image. Scores of half
    precision become float32, and the head is exact. The fused file is run before it takes its
    place: the network must label a golden image as before, and the head must agree with `SSRVLAD`.

    Shape:
        - input: the network's own.
        - outputs: the network's own, and ``descriptor (B, config.length)`` float32, ``keypoints
          (B, 8)`` int64 and ``unknown (B,)`` int64, whose names get the prefix ``ssrvlad/`` where
          the network has such names.

    Args:
        network: an ONNX graph with class scores ``(B, C, h, w)`` or ``(B, h, w, C)`` in half,
            single or double precision, or labels ``(B, h, w)``, ``(B, 1, h, w)`` or
            ``(B, h, w, 1)``. One below opset 18 is raised to it. External weights lie beside it.
        config: the settings of the head; ``labels_as`` is the label space of the network.
        path: the file; what was there is replaced, whole or not at all. Beyond 2 GB the weights
            go to a file beside it.
        output: the output to take, if several could be labels.

    Raises:
        ValueError: the graph is damaged, cannot be run or raised, has no output or several that
            fit the label space, gives ids outside it, or has a head already.
        ImportError: the extra ``onnx`` is not installed.
        OSError: the file cannot be written.
    """
    network, path = Path(network), Path(path)
    try:
        return _fuse(network, config, path, output)
    except ValueError as error:
        named = str(error).startswith(str(network))
        raise ValueError(str(error) if named else f"{network}: {error}") from error


def _fuse(network: Path, config: SSRVLADConfig, path: Path, output: str | None) -> FusedNetwork:
    head = SSRVLAD(config)
    model = load_model(network)
    if any(entry.key.startswith(PREFIX) for entry in model.metadata_props):
        raise ValueError("has a head already; wanted the network alone")
    session = open_session(network, network)
    before = run_on_golden_image(session)
    taken = find_label_output(session, before and before[1], head.label_space, output)
    given = next(value.type for value in session.get_outputs() if value.name == taken.name)
    head_alone = head_model(config, "labels", taken.dtype)
    fused = _names(network, model, head_alone, taken)
    _raise_opset(model)
    _join(model, head_alone, fused, given)
    digest = {DIGEST: graph_digest(model)}

    def describe(file: Path) -> dict[str, str]:
        golden = before and _golden(open_session(file, file.name), before, fused, head)
        return digest | _properties(model, head_alone, fused, golden, head)

    save_model(model, path, describe)
    return fused


def _names(
    network: Path, model: onnx.ModelProto, head: onnx.ModelProto, taken: LabelOutput
) -> FusedNetwork:
    """New names that the network has not."""
    used = names_of(model.graph)
    prefix = "ssrvlad/"
    while any(name.startswith(prefix) for name in used):
        prefix = f"_{prefix}"
    heads = {
        value.name: f"{prefix}{value.name}" if value.name in used else value.name
        for value in head.graph.output
    }
    with network.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return FusedNetwork(
        network.name, digest, taken.name, taken.kind, taken.axis, taken.dtype, prefix, heads
    )


def _raise_opset(model: onnx.ModelProto) -> None:
    """Brings a network to the head's opset, in place, if it is below."""
    from onnx import version_converter

    version = opset(model)
    if version >= OPSET:
        return
    try:
        raised = version_converter.convert_version(model, OPSET)
    except Exception as error:  # the converter's own types, and protobuf's beyond 2 GB
        raise ValueError(
            f"cannot be raised from opset {version} to {OPSET}: {one_line(error)}; "
            f"export it with opset {OPSET} or newer"
        ) from error
    model.CopyFrom(raised)


def _join(model: onnx.ModelProto, head: onnx.ModelProto, fused: FusedNetwork, given: str) -> None:
    """Adds the head to a network, in place."""
    from onnx import helper, version_converter

    version = opset(model)
    ours = head if version == OPSET else version_converter.convert_version(head, version)
    rename(ours.graph, lambda name: fused.heads.get(name, f"{fused.prefix}{name}"))
    nodes, tables = fused.label_output().nodes(fused.prefix, given)
    model.graph.node.extend([*nodes, *ours.graph.node])
    model.graph.initializer.extend([*tables, *ours.graph.initializer])
    labels = ours.graph.input[0].type.tensor_type.elem_type
    model.graph.value_info.append(
        helper.make_tensor_value_info(f"{fused.prefix}labels", labels, [None] * 3)
    )
    network_output = next(value for value in model.graph.output if value.name == fused.output)
    for value in ours.graph.output:
        value.type.tensor_type.shape.dim[0].CopyFrom(_batch(network_output, fused.prefix))
    model.graph.output.extend(ours.graph.output)
    model.ir_version = max(model.ir_version, ours.ir_version)


def _golden(
    session: Any, before: tuple[npt.NDArray[Any], Arrays], fused: FusedNetwork, head: SSRVLAD
) -> Arrays:
    """The golden image and what the module makes of the labels that the graph gives it.

    Raises:
        ValueError: the network does not label it as before, or the head disagrees.
    """
    images, expected = before
    given = session.get_inputs()[0].name
    outputs = run_by_name(session, {given: images})
    taken = fused.label_output()
    labels, old = taken.labels(outputs[taken.name]), taken.labels(expected[taken.name])
    share = float((labels != old).mean())
    if share > MOST_OTHER_PIXELS:
        raise ValueError(f"labels {share:.1%} of a golden image otherwise once it is fused")
    result = described(head, labels)
    for name, array in result.items():
        if not np.allclose(outputs[fused.heads[name]], array, rtol=0, atol=1e-6):
            raise ValueError(f"the fused head gives another {name} than the PyTorch module")
    named = {fused.heads[name]: array for name, array in result.items()}
    return {given: images, f"{fused.prefix}labels": labels, **named}


def described(head: SSRVLAD, given: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """What the module makes of labels or class scores, by the names of a file's outputs."""
    view = head.explain(torch.from_numpy(given))
    return {
        "descriptor": view.descriptor.numpy(),
        "keypoints": view.keypoints.sum((2, 3)).numpy(),
        "unknown": np.zeros(len(given), np.int64),
    }


def run_by_name(session: Any, inputs: Arrays) -> dict[str, npt.NDArray[Any]]:
    """All outputs of a session by name."""
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, dict(inputs)), strict=True))


def _properties(
    model: onnx.ModelProto,
    head_alone: onnx.ModelProto,
    fused: FusedNetwork,
    golden: Arrays | None,
    head: SSRVLAD,
) -> dict[str, str]:
    """Metadata of the fused file; without a golden image the golden pair is the head's alone."""
    own = {entry.key: entry.value for entry in model.metadata_props}
    alone = Metadata.from_properties({e.key: e.value for e in head_alone.metadata_props})
    weights = {tensor.name for tensor in model.graph.initializer}
    interface = {
        "opset": opset(model),
        "inputs": dict(_form(v) for v in model.graph.input if v.name not in weights),
        "outputs": dict(map(_form, model.graph.output)),
    }
    pair = alone.golden_arrays() if golden is None else golden
    metadata = Metadata.of(head.config, head.label_space, interface, pair)
    extra = {NETWORK: json.dumps(asdict(fused)), HEAD_GOLDEN: json.dumps(alone.golden)}
    return own | metadata.to_properties() | extra


def opset(model: onnx.ModelProto) -> int:
    """Version of the standard operators that a model uses."""
    versions = [one.version for one in model.opset_import if one.domain in _ONNX_DOMAINS]
    return int(max(versions, default=1))


def _batch(value: onnx.ValueInfoProto, prefix: str) -> onnx.TensorShapeProto.Dimension:
    """The axis of the images."""
    import onnx

    if value.type.tensor_type.shape.dim:
        batch: onnx.TensorShapeProto.Dimension = value.type.tensor_type.shape.dim[0]
        return batch
    return onnx.TensorShapeProto.Dimension(dim_param=f"{prefix}B")


def _form(value: onnx.ValueInfoProto) -> tuple[str, dict[str, Any]]:
    from onnx import helper

    kind = value.type.tensor_type
    shape = [axis.dim_param or axis.dim_value or None for axis in kind.shape.dim]
    known = kind.elem_type and helper.tensor_dtype_to_np_dtype(kind.elem_type).name
    dtype = known or "no tensor"
    return value.name, {"dtype": dtype, "shape": shape}
