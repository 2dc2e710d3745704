"""Export: the head as one ONNX file of standard operators, exact, for images of any size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config import CATEGORY_COUNT, SSRVLADConfig
from ..descriptor import SSRVLAD, SweepHead
from ..files import check_output, replacing
from ..onnx_files import graph_digest
from ..taxonomy import LabelSpace
from .arithmetic.fixed import check_shape, fold_sizes
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

    The file has standard operators only and computes in int32 and float32: ONNX Runtime and
    OpenVINO on a CPU run it. Counts equal those of `SSRVLAD`, descriptors differ by less than 1e-6;
    with a ``power`` below 0.55, which enlarges rounding errors of numbers near zero, by up to 3e-6.
    OpenVINO divides int32 in float32, so it is exact for batches of up to 16 million pixels of the
    working grid; it cuts int64 labels to 32 bits. Where the graph cannot count exactly the
    descriptor is NaN: on a grid of more than 960 columns (harmonics around the vanishing column),
    or for 2 ** 31 pairs of points in a layer (residuals). A graph cannot raise an error: pixels
    with an id outside the label space belong to no layer, and the output ``unknown`` counts them.
    NaN scores are not noticed.

    Shape:
        - input: ``labels (B, H, W)`` or ``logits (B, C, H, W)`` float32 (the first of the largest
          wins); all axes are dynamic, unless ``shape`` is given.
        - outputs: ``descriptor (B, config.length)`` float32, for a sweep ``(B, S, config.length)``,
          ``unknown (B,)`` int64, and for the aggregation ``residuals`` ``keypoints (B, 8)`` int64,
          the number in each layer.

    Args:
        config: the settings.
        path: the file; an existing one is replaced, whole or not at all.
        input: ``"labels"`` or ``"logits"``.
        dtype: dtype of the labels: ``"uint8"`` (default), ``"int32"`` or ``"int64"``; class scores
            are float32.
        columns: S anchors of `SSRVLAD.sweep`; empty for single descriptors.
        form: ``"standard"``, or ``"arithmetic"`` for the aggregation harmonics: the same numbers
            without bitwise operators, loops and shapes that depend on pixel values; slower on a
            CPU.
        shape: fixed B, H and W, for the form ``"arithmetic"``; C is the largest number of classes
            of the label space. Everything that depends on sizes only is computed now, and the file
            computes in float32 and int32.

    Raises:
        ValueError: an unknown input, dtype, form or label space, class scores for a label space
            whose ids have gaps, a sweep of descriptors without an anchor, a form or shape that
            these settings do not have, or a shape whose sums are not exact.
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
    """The model that `export_head` writes; arguments and errors as there."""
    head = SweepHead(config, columns) if columns else SSRVLAD(config)
    if input == "logits" and dtype is not None:
        raise ValueError(f"dtype is for labels, class scores are float32; got {dtype!r}")
    dtype = dtype or DTYPES[0]
    _check(config, form, shape)
    inputs = _inputs(head.label_space, input, dtype, shape)
    graph = Graph(inputs)
    (labels,) = graph.inputs
    if input == "logits":
        labels = graph.ArgMax(labels, axis=1, keepdims=0)
    describe = describe_in_arithmetic if form == "arithmetic" else describe_in_graph
    symbols = describe(graph, labels, config, columns)
    images = shape[0] if shape else "B"
    forms: dict[str, Form] = {
        "descriptor": ("float32", [images, *([len(columns)] if columns else []), config.length]),
        "unknown": ("int64", [images]),
        "keypoints": ("int64", [images, CATEGORY_COUNT]),
    }
    outputs = {name: forms[name] for name in symbols}
    model = graph.model({name: (symbols[name], outputs[name]) for name in outputs})
    if shape:
        model = fold_sizes(model)
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
    _add_metadata(model, metadata)
    return model


def _check(config: SSRVLADConfig, form: str, shape: tuple[int, int, int] | None) -> None:
    """Checks that the settings have this form and shape.

    Raises:
        ValueError: they do not.
    """
    if form not in FORMS:
        raise ValueError(f"form must be one of {', '.join(FORMS)}, got {form!r}")
    if form == "standard":
        if shape:
            raise ValueError(f"form standard takes any size, got {shape}; expected form arithmetic")
        return
    if config.aggregation != "harmonics":
        raise ValueError(f"form arithmetic is for harmonics, got aggregation {config.aggregation}")
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


def _add_metadata(model: onnx.ModelProto, metadata: Metadata) -> None:
    """Writes producer, description and metadata properties into a model."""
    import onnx

    model.producer_name = "ssrvlad_torch"
    model.producer_version = metadata.version
    model.doc_string = "SSR-VLAD (arXiv 2202.03677): segmentation label maps to place descriptors"
    properties = metadata.to_properties()
    properties[SEAL] = seal(graph_digest(model), properties)
    onnx.helper.set_model_props(model, properties)
