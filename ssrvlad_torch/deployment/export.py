"""Export: the head as one ONNX file of standard operators, exact, for images of any size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from ..config import CATEGORY_COUNT, SSRVLADConfig
from ..descriptor import SSRVLAD
from ..files import check_output, replacing, requiring
from ..segmentation.onnx_files import open_session
from ..stages.vanishing_column import MAX_WIDTH
from .golden import SIZE, golden_pair
from .metadata import Metadata
from .trace import Axes, interface, traced

if TYPE_CHECKING:
    import onnx

INPUTS = ("labels", "logits")
DTYPES = ("uint8", "int32", "int64")


def export_head(
    config: SSRVLADConfig,
    path: str | Path,
    input: str = "labels",
    dtype: str | None = None,
    columns: Sequence[int] = (),
    shape: tuple[int, int, int] | None = None,
) -> None:
    """Writes the head as one ONNX file: label ids or class scores to descriptors.

    The file is `SSRVLAD`, traced to standard operators; ``default`` needs no loop. Counts equal
    those of `SSRVLAD`, descriptors differ by less than 1e-6; export/README.md has the exceptions.
    Where the graph cannot count exactly the descriptor is NaN: on a grid of more than 960 columns
    (harmonics), or for 2 ** 31 pairs of points in a layer (residuals). A graph cannot raise an
    error: pixels with an id outside the label space belong to no layer, and the output ``unknown``
    counts them. NaN scores are not noticed.

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
        dtype: of the labels: ``"uint8"`` (default), ``"int32"`` or ``"int64"``.
        columns: S anchors of `SSRVLAD.sweep`, an odd number with 0 in the middle; empty for single
            descriptors.
        shape: fixed B, H and W, for the aggregation harmonics; C is the largest number of classes
            of the label space.

    Raises:
        ValueError: an argument is none of the above, or does not fit the settings or the label
            space; or ONNX Runtime does not load the file.
        ImportError: the extra ``onnx`` is not installed.
        OSError: the file cannot be written.
    """
    check_output(Path(path))
    content = head_model(config, input, dtype, columns, shape).SerializeToString()
    open_session(content, str(path))  # an exporter may write what does not load
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(content)


def head_model(
    config: SSRVLADConfig,
    input: str = "labels",
    dtype: str | None = None,
    columns: Sequence[int] = (),
    shape: tuple[int, int, int] | None = None,
) -> onnx.ModelProto:
    """The model that `export_head` writes; arguments and errors as there."""
    with requiring("onnx", "ONNX graphs need"):
        import onnx
    head = SSRVLAD(config, columns)
    if columns and (len(columns) % 2 == 0 or columns[len(columns) // 2]):
        raise ValueError(
            "columns: expected an odd number with 0 in the middle, from where the frames of a map "
            f"are described, got {list(columns)}"
        )
    if input == "logits" and dtype is not None:
        raise ValueError(f"dtype is for labels, class scores are float32; got {dtype!r}")
    dtype = dtype or DTYPES[0]
    _check(head, input, dtype, shape)
    golden = golden_pair(head, input, dtype, shape)
    axes: Axes = shape or ("B", "H", "W")
    example = torch.zeros(shape or (2, *SIZE), dtype=getattr(torch, dtype))
    if input == "logits":
        channels = head.label_space.channel_counts[-1]
        axes = (axes[0], channels if shape else "C", *axes[1:])
        example = example.new_zeros((len(example), channels, *example.shape[1:]), dtype=torch.float)
    swept = [len(columns)] if columns else []
    outputs: dict[str, Axes] = {
        "descriptor": [axes[0], *swept, config.length],
        "unknown": [axes[0]],
    }
    if config.aggregation == "residuals":
        outputs["keypoints"] = [axes[0], CATEGORY_COUNT]
    model = traced(head, {input: (example, axes)}, outputs, "counted")
    model.ir_version = 8  # the newest that ONNX Runtime 1.17 reads
    model.producer_name = "ssrvlad_torch"
    model.doc_string = "SSR-VLAD (arXiv 2202.03677): segmentation label maps to place descriptors"
    form = interface(model) | ({"sweep": list(columns)} if columns else {})
    metadata = Metadata.of(config, head.label_space, form, golden)
    model.producer_version = metadata.version
    onnx.helper.set_model_props(model, metadata.to_properties())
    return model


def _check(head: SSRVLAD, input: str, dtype: str, shape: tuple[int, int, int] | None) -> None:
    config, space = head.config, head.label_space
    if input not in INPUTS:
        raise ValueError(f"input must be one of {', '.join(INPUTS)}, got {input!r}")
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    if input == "logits" and not space.channel_counts:
        raise ValueError(f"label space {space.name} has no class scores, its ids have gaps")
    if not shape:
        return
    if config.aggregation != "harmonics":
        raise ValueError(f"a fixed size is for harmonics, got aggregation {config.aggregation}")
    images, height, width = shape
    if min(shape) < 1 or max(images, height * width) > 1 << 24:
        raise ValueError(
            f"{images} images of {height} x {width}; expected 1 to 2 ** 24 images, and as many "
            "pixels in each"
        )
    columns = config.grid(height, width)[1]
    if columns > MAX_WIDTH:
        raise ValueError(f"{width} columns make a grid of {columns}; expected at most {MAX_WIDTH}")
