"""A graph of fixed size: whatever depends on sizes only is computed when the file is written."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...config import SSRVLADConfig
from .reduction import WIDEST_CELL
from .vanishing_column import WIDEST

if TYPE_CHECKING:
    import onnx

_MOST_PIXELS = 1 << 24
_NO_LIMIT = 1 << 30


def folded(model: onnx.ModelProto) -> onnx.ModelProto:
    """A model whose inputs have fixed sizes, without the nodes that give the same for any input.

    What is left computes in float32 and int32; int64 are shapes and axes, which are constants, and
    what the outputs hold.
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
    for tidy in passes:
        tidy(graph)
    return ir.to_proto(graph)


def check_shape(config: SSRVLADConfig, shape: tuple[int, int, int]) -> None:
    """Whether every sum over images of this shape is exact in float32.

    Raises:
        ValueError: it is not, or the shape holds no pixel.
    """
    images, height, width = shape
    if min(shape) < 1 or height * width > _MOST_PIXELS:
        raise ValueError(
            f"images of {height} x {width}, {images} together; expected 1 to 2 ** 24 pixels"
        )
    columns = config.grid(height, width)[1]
    if columns > WIDEST or -(-width // columns) > WIDEST_CELL:
        raise ValueError(
            f"{width} columns make a grid of {columns}; expected at most {WIDEST}, of at most "
            f"{WIDEST_CELL} pixels each"
        )
