"""The front end of the method: label map -> layers on the working grid (Table II)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from ..config import SSRVLADConfig
from ..taxonomy import NO_LAYER, LabelSpace, label_space
from .layers import UNKNOWN, best_class, categorise, category_table, refuse_unknown
from .reduction import reduce_by_majority
from .tracing import exporting, length

PIXELS_AT_ONCE = 1 << 20
"""Label map pixels that are processed at a time, at least one image."""


class FrontEnd(nn.Module):
    """Label maps or class scores -> the layer of each pixel of the working grid.

    Shape:
        - input: as for `SSRVLAD`; what it refuses is a ValueError.
        - output: ``(B, h, w)`` uint8, 0 to 7 or `NO_LAYER`.
    """

    def __init__(self, config: SSRVLADConfig) -> None:
        super().__init__()
        self.config = config
        self.label_space = label_space(config.labels_as)
        self.table: Tensor
        table, self.origin = category_table(self.label_space)
        self.register_buffer("table", table, persistent=False)

    def forward(self, labels: Tensor) -> Tensor:
        """The layers of a batch, a few images at a time so that memory stays bounded."""
        labels = label_map(labels, self.label_space)
        parts = []
        for chunk in labels.split(max(1, PIXELS_AT_ONCE // labels[0].numel())):
            layers, unknown = self.counted(chunk)
            if bool(unknown.any()):
                refuse_unknown(labels, self.label_space)
            parts.append(layers)
        return torch.cat(parts)

    def counted(self, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Layers of a label map, and the number of pixels of each image that have an unknown id and
        no layer."""
        size = self.config.working_size
        categories = categorise(labels, self.table, self.origin).int()  # Table II
        unknown = (categories == UNKNOWN).sum((1, 2))
        layers = categories.clamp(max=NO_LAYER)
        if size is None:
            return layers.to(torch.uint8), unknown
        _, height, width = labels.shape
        shorter = torch.sym_min(height, width)
        size = torch.sym_min(shorter, size)
        rows, columns = (
            length((2 * side * size + shorter) // (2 * shorter)) for side in (height, width)
        )
        return reduce_by_majority(layers, (rows, columns)), unknown


def label_map(labels: Tensor, space: LabelSpace) -> Tensor:
    """The label map of an input; for class scores, the class of the highest score. A wrong rank,
    dtype or number of classes, and an empty batch or image, are a ValueError."""
    if torch.jit.is_tracing():  # type: ignore[attr-defined]
        raise RuntimeError(
            "torch.jit.trace cannot record SSRVLAD, nor can torch.onnx.export(dynamo=False); "
            "torch.export.export can, and export_head or `ssrvlad fuse` writes it as an ONNX file"
        )
    got = f"got {tuple(labels.shape)} {str(labels.dtype).removeprefix('torch.')}"
    if labels.ndim == 3 and (labels.is_floating_point() or labels.dtype == torch.bool):
        raise ValueError(f"a (B, H, W) label map must hold integer ids, {got}")
    if labels.ndim == 4 and not labels.is_floating_point():
        raise ValueError(f"(B, C, H, W) class scores must be floating point, {got}")
    if labels.ndim not in (3, 4) or labels.is_complex():
        raise ValueError(f"expected (B, H, W) label ids or (B, C, H, W) class scores, {got}")
    if not exporting() and labels.numel() == 0:
        raise ValueError(f"expected at least one image of at least one pixel, {got}")
    if labels.ndim == 3:
        return labels
    if not _has_classes(labels, space):
        counts = " or ".join(map(str, space.channel_counts)) or "no class scores, its ids have gaps"
        raise ValueError(
            f"class scores have {labels.shape[1]} classes; label space {space.name} takes {counts}"
        )
    return best_class(labels)


def labels_in(outputs: Mapping[Any, object], space: LabelSpace) -> Tensor:
    """The one of the outputs of a network, by name, that is a label map or class scores of a label
    space; of several, ``out`` or ``logits``. None, or several others, are a ValueError."""
    tensors = {name: output for name, output in outputs.items() if isinstance(output, Tensor)}
    fitting = {
        name: output
        for name, output in tensors.items()
        if (output.ndim == 4 and output.is_floating_point() and _has_classes(output, space))
        or (output.ndim == 3 and not output.is_floating_point() and output.dtype != torch.bool)
    }
    usual = [name for name in ("out", "logits") if name in fitting]
    if len(fitting) != 1 and not usual:
        got = ", ".join(f"{name} {tuple(output.shape)}" for name, output in tensors.items())
        raise ValueError(
            f"expected one output that is labels of {space.name}, {len(fitting)} fit: got "
            f"{got or 'no tensors'}"
        )
    return fitting[usual[0]] if usual else next(iter(fitting.values()))


def _has_classes(scores: Tensor, space: LabelSpace) -> bool:
    """Whether the number of classes fits; a symbol, for which torch.compile has no range, does."""
    expected, count = space.channel_counts, scores.shape[1]
    return not isinstance(count, int) or expected.start <= count < expected.stop


def as_tensor(labels: Tensor | npt.NDArray[Any]) -> Tensor:
    """A tensor as it is, or an array as a tensor that shares its memory where possible. Other
    input, and a tensor without values in memory, are a ValueError."""
    if isinstance(labels, Tensor) and not labels.is_meta and labels.layout is torch.strided:
        return labels
    if isinstance(labels, np.ndarray) and labels.dtype.kind in "biufc":
        native = labels.astype(labels.dtype.newbyteorder("="), copy=False)
        return torch.from_numpy(np.require(native, requirements=["C", "W"]))
    if isinstance(labels, Tensor):
        raise ValueError(
            f"expected a dense tensor in memory, got {labels.layout} on {labels.device}"
        )
    kind = f"{type(labels).__module__.split('.')[0]} {type(labels).__name__}"
    if isinstance(labels, np.ndarray):
        kind = f"an array of {labels.dtype}"
    hint = "; a picture's labels are np.asarray(picture)[None]" if kind.startswith("PIL") else ""
    raise ValueError(
        f"expected a (B, H, W) or (B, C, H, W) tensor or NumPy array, got {kind}{hint}"
    )
