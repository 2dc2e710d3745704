"""Export: the head as one ONNX file of standard operators, exact and of any size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config import CATEGORY_COUNT, SSRVLADConfig
from ..descriptor import SSRVLAD, SweepHead
from ..files import check_output, replacing
from ..onnx_files import graph_digest
from ..taxonomy import LabelSpace
from .golden import golden_pair
from .graph import OPSET, Form, Graph
from .head_graph import describe_in_graph
from .metadata import SEAL, Metadata, seal

if TYPE_CHECKING:
    import onnx

INPUTS = ("labels", "logits")
DTYPES = ("uint8", "int64")


def export_head(
    config: SSRVLADConfig,
    path: str | Path,
    input: str = "labels",
    dtype: str = "uint8",
    columns: Sequence[int] = (),
) -> None:
    """Writes the head as one ONNX file: label ids or class scores to descriptors.

    The file holds standard operators only and computes in int32 and float32: ONNX Runtime and
    OpenVINO on a CPU run it. Counts are those of `SSRVLAD`, descriptors differ by less than 1e-6.
    OpenVINO divides int32 in float32 and is exact for batches of up to 16 million pixels
    of the working grid, and it cuts int64 labels to 32 bits. A descriptor of more than the graph
    can count is NaN: of a grid wider than 960 columns (harmonics around the vanishing column), or
    of 2 ** 31 pairs of points in a layer (residuals). A graph cannot raise an error:
    pixels with an id outside the label space belong to no layer, and the output ``unknown``
    counts them. It does not notice NaN scores.

    Shape:
        - input: ``labels (B, H, W)`` or ``logits (B, C, H, W)`` float32 (the largest wins, the
          first of equals), all axes dynamic.
        - outputs: ``descriptor (B, config.length)`` float32, of a sweep ``(B, S, config.length)``,
          ``unknown (B,)`` int64, and of the aggregation ``residuals`` ``keypoints (B, 8)`` int64,
          how many each layer has.

    Args:
        config: the settings.
        path: the file; what was there is replaced, whole or not at all.
        input: ``"labels"`` or ``"logits"``.
        dtype: of the labels, ``"uint8"`` or ``"int64"``.
        columns: S anchors of `SSRVLAD.sweep`; none for single descriptors.

    Raises:
        ValueError: an unknown input, dtype or label space, class scores for a label space whose
            ids have gaps, or a sweep of descriptors that have no anchor.
        ImportError: the extra ``onnx`` is not installed.
        OSError: the file cannot be written.
    """
    path = Path(path)
    check_output(path)
    content = head_model(config, input, dtype, columns).SerializeToString()
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def head_model(
    config: SSRVLADConfig,
    input: str = "labels",
    dtype: str = "uint8",
    columns: Sequence[int] = (),
) -> onnx.ModelProto:
    """What `export_head` writes; arguments and errors as there."""
    head = SweepHead(config, columns) if columns else SSRVLAD(config)
    inputs = _inputs(head.label_space, input, dtype)
    graph = Graph(inputs)
    (given,) = graph.inputs
    labels = graph.ArgMax(given, axis=1, keepdims=0) if input == "logits" else given
    described = describe_in_graph(graph, labels, config, columns)
    forms: dict[str, Form] = {
        "descriptor": ("float32", ["B", *([len(columns)] if columns else []), config.length]),
        "unknown": ("int64", ["B"]),
        "keypoints": ("int64", ["B", CATEGORY_COUNT]),
    }
    outputs = {name: forms[name] for name in described}
    model = graph.model({name: (described[name], outputs[name]) for name in outputs})
    interface: dict[str, Any] = {
        "opset": OPSET,
        "inputs": _as_json(inputs),
        "outputs": _as_json(outputs),
    }
    if columns:
        interface["sweep"] = list(columns)
    golden = golden_pair(head, input, dtype)
    metadata = Metadata.of(config, head.label_space, interface, golden)
    _label(model, metadata)
    return model


def _inputs(space: LabelSpace, input: str, dtype: str) -> dict[str, Form]:
    if input not in INPUTS:
        raise ValueError(f"input must be one of {', '.join(INPUTS)}, got {input!r}")
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    if input == "labels":
        return {"labels": (dtype, ["B", "H", "W"])}
    if not space.channel_counts:
        raise ValueError(f"label space {space.name} has no class scores, its ids have gaps")
    return {"logits": ("float32", ["B", "C", "H", "W"])}


def _as_json(forms: Mapping[str, Form]) -> dict[str, Any]:
    return {name: {"dtype": dtype, "shape": shape} for name, (dtype, shape) in forms.items()}


def _label(model: onnx.ModelProto, metadata: Metadata) -> None:
    """Writes into a model who made it and what it is."""
    import onnx

    model.producer_name = "ssrvlad_torch"
    model.producer_version = metadata.version
    model.doc_string = "SSR-VLAD (arXiv 2202.03677): segmentation label maps to place descriptors"
    properties = metadata.to_properties()
    properties[SEAL] = seal(graph_digest(model), properties)
    onnx.helper.set_model_props(model, properties)
