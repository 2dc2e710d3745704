"""Graphs of fixed size: everything that depends on sizes only is computed at export."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...config import SSRVLADConfig
from .reduction import MAX_CELL_WIDTH
from .vanishing_column import MAX_WIDTH

if TYPE_CHECKING:
    import onnx

_MAX_PIXELS = 1 << 24
_NO_LIMIT = 1 << 30


def fold_sizes(model: onnx.ModelProto) -> onnx.ModelProto:
    """A model with inputs of fixed sizes, without the nodes that do not depend on pixel values.

    The other nodes compute in float32 and int32; only shapes and axes, which are constants, and
    outputs are int64.
    """
    import onnx_ir as ir
    from onnx_ir.passes import common
    from onnxscript import optimizer

    graph = ir.from_proto(model)
    optimizer.fold_constants(
        graph,
        onnx_shape_inference=True,
        output_size_limit=_NO_LIMIT,
        should_fold=lambda node: True,
    )
    passes = (
        common.IdentityEliminationPass(),
        common.CommonSubexpressionEliminationPass(),
        common.RemoveUnusedNodesPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.DeduplicateInitializersPass(),
    )
    for each in passes:
        each(graph)
    return ir.to_proto(graph)


def check_shape(config: SSRVLADConfig, shape: tuple[int, int, int]) -> None:
    """Checks that every sum over images of this shape is exact in float32.

    Raises:
        ValueError: it is not, or the shape has no pixels.
    """
    images, height, width = shape
    if min(shape) < 1 or height * width > _MAX_PIXELS or images > _MAX_PIXELS:
        raise ValueError(
            f"{images} images of {height} x {width}; expected 1 to 2 ** 24 images, and as many "
            "pixels in each"
        )
    columns = config.grid(height, width)[1]
    if columns > MAX_WIDTH or -(-width // columns) > MAX_CELL_WIDTH:
        raise ValueError(
            f"{width} columns make a grid of {columns}; expected at most {MAX_WIDTH}, of at most "
            f"{MAX_CELL_WIDTH} pixels each"
        )
