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
from .arithmetic.fixed import check_shape, folded
from .arithmetic.head import describe_in_arithmetic
from .golden import golden_pair
from .graph import OPSET, Form, Graph
from .head_graph import describe_in_graph
from .metadata import SEAL, Metadata, seal

if TYPE_CHECKING:
    import onnx

INPUTS = ("labels", "logits")
DTYPES = ("uint8", "int32", "int64")
FORMS = ("standard", "arithmetic")


def export_head(
    config: SSRVLADConfig,
    path: str | Path,
    input: str = "labels",
    dtype: str | None = None,
    columns: Sequence[int] = (),
    form: str = "standard",
    shape: tuple[int, int, int] | None = None,
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
          first of equals); all axes dynamic, but with ``shape`` those of it.
        - outputs: ``descriptor (B, config.length)`` float32, of a sweep ``(B, S, config.length)``,
          ``unknown (B,)`` int64, and of the aggregation ``residuals`` ``keypoints (B, 8)`` int64,
          how many each layer has.

    Args:
        config: the settings.
        path: the file; what was there is replaced, whole or not at all.
        input: ``"labels"`` or ``"logits"``.
        dtype: of the labels, ``"uint8"``, the default, ``"int32"`` or ``"int64"``; class scores
            are float32.
        columns: S anchors of `SSRVLAD.sweep`; none for single descriptors.
        form: ``"standard"``, or ``"arithmetic"`` for the aggregation harmonics: the same numbers
            without bitwise operators, loops and shapes that depend on what is in the picture,
            slower on a CPU.
        shape: B, H and W of a file in the form ``"arithmetic"`` that takes no others; C is the
            largest number of classes of the label space. What depends on sizes only is computed
            now, and what is left is in float32 and int32.

    Raises:
        ValueError: an unknown input, dtype, form or label space, class scores for a label space
            whose ids have gaps, a sweep of descriptors that have no anchor, a form or shape that
            is not for these settings, or a shape of which the file can count no pixels.
        ImportError: the extra ``onnx`` is not installed.
        OSError: the file cannot be written.
    """
    path = Path(path)
    check_output(path)
    model = head_model(config, input, dtype, columns, form, shape)
    content = model.SerializeToString()
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def head_model(
    config: SSRVLADConfig,
    input: str = "labels",
    dtype: str | None = None,
    columns: Sequence[int] = (),
    form: str = "standard",
    shape: tuple[int, int, int] | None = None,
) -> onnx.ModelProto:
    """What `export_head` writes; arguments and errors as there."""
    head = SweepHead(config, columns) if columns else SSRVLAD(config)
    if input == "logits" and dtype is not None:
        raise ValueError(f"dtype is of labels, and class scores are float32; got {dtype!r}")
    dtype = dtype or DTYPES[0]
    _check(config, form, shape)
    inputs = _inputs(head.label_space, input, dtype, shape)
    graph = Graph(inputs)
    (given,) = graph.inputs
    labels = graph.ArgMax(given, axis=1, keepdims=0) if input == "logits" else given
    describe = describe_in_arithmetic if form == "arithmetic" else describe_in_graph
    described = describe(graph, labels, config, columns)
    images = shape[0] if shape else "B"
    forms: dict[str, Form] = {
        "descriptor": ("float32", [images, *([len(columns)] if columns else []), config.length]),
        "unknown": ("int64", [images]),
        "keypoints": ("int64", [images, CATEGORY_COUNT]),
    }
    outputs = {name: forms[name] for name in described}
    model = graph.model({name: (described[name], outputs[name]) for name in outputs})
    if shape:
        model = folded(model)
    interface: dict[str, Any] = {
        "opset": OPSET,
        "form": form,
        "inputs": _as_json(inputs),
        "outputs": _as_json(outputs),
    }
    if columns:
        interface["sweep"] = list(columns)
    golden = golden_pair(head, input, dtype, shape)
    metadata = Metadata.of(config, head.label_space, interface, golden)
    _label(model, metadata)
    return model


def _check(config: SSRVLADConfig, form: str, shape: tuple[int, int, int] | None) -> None:
    """Whether there is such a form.

    Raises:
        ValueError: there is none.
    """
    if form not in FORMS:
        raise ValueError(f"form must be one of {', '.join(FORMS)}, got {form!r}")
    if form == "standard":
        if shape:
            raise ValueError(f"form standard takes any size, got {shape}; expected form arithmetic")
        return
    if config.aggregation != "harmonics":
        raise ValueError(f"form arithmetic is of harmonics, got aggregation {config.aggregation}")
    if shape:
        check_shape(config, shape)


def _inputs(
    space: LabelSpace, input: str, dtype: str, shape: tuple[int, int, int] | None
) -> dict[str, Form]:
    if input not in INPUTS:
        raise ValueError(f"input must be one of {', '.join(INPUTS)}, got {input!r}")
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    images, *size = shape or ("B", "H", "W")
    if input == "labels":
        return {"labels": (dtype, [images, *size])}
    if not space.channel_counts:
        raise ValueError(f"label space {space.name} has no class scores, its ids have gaps")
    channels = space.channel_counts[-1] if shape else "C"
    return {"logits": ("float32", [images, channels, *size])}


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
