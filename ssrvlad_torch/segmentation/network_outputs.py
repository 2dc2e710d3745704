"""Outputs of segmentation networks: which output holds labels, and the class of every pixel."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ..stages.layers import best_class
from ..taxonomy import LabelSpace, label_space, label_space_names

Classes = tuple[int, int] | None
"""The first channel of the scores to use and the one after the last; ``None`` for all."""


_QUANTISED = torch.uint8, torch.int8
"""Dtypes of class scores of quantised networks."""


class UnrecognisedError(ValueError):
    """No output of a network can be labels, or several can."""


def tensors_of(result: object) -> dict[str, Tensor]:
    """The tensors in a result by name: a tensor, a mapping, an object with ``logits``, or a tuple,
    named ``0``, ``1`` and so on. None is an UnrecognisedError."""
    if isinstance(result, Tensor):
        named: Mapping[object, object] = {"output": result}
    elif isinstance(result, Mapping):
        named = result
    elif isinstance(result, tuple | list):
        named = dict(enumerate(result))
    else:
        named = {"logits": getattr(result, "logits", None)}
    tensors = {
        str(key): value.dequantize() if value.is_quantized else value
        for key, value in named.items()
        if isinstance(value, Tensor)
    }
    if not tensors:
        raise UnrecognisedError(f"the network gives a {type(result).__name__} without tensors")
    return tensors


def choose_output(
    outputs: Mapping[str, Tensor],
    space: LabelSpace,
    size: Sequence[int],
    channels_last: bool = False,
    name: str | None = None,
    classes: Classes = None,
) -> tuple[str, int | None]:
    """The name of the output that holds labels and the axis of its classes, ``None`` for ids
    without one; with a ``name`` only that can. None, or several but for ``out`` or ``logits``, are
    an UnrecognisedError.

    Class scores are floats, or of 8 bits, ``(B, C, h, w)`` or ``(B, h, w, C)``, with as many
    channels as the label space has classes; ids are integers, ``(B, h, w)``, ``(B, 1, h, w)`` or
    ``(B, h, w, 1)``. If two axes can be that of the classes, the others are proportional to the
    ``size`` of the input; of a square, its layout decides, that has or not ``channels_last``."""
    if name is not None and name not in outputs:
        raise UnrecognisedError(f"there is no output {name!r}; the outputs are {_list(outputs)}")
    candidates = outputs if name is None else {name: outputs[name]}
    axes = {key: _class_axes(output, space, classes) for key, output in candidates.items()}
    fitting = {key: candidates[key] for key in axes if axes[key]}
    if not fitting:
        counts = " or ".join(map(str, space.channel_counts)) or "none, for its ids have gaps"
        counts += f" of channels {classes[0]}:{classes[1]}" if classes else ""
        raise UnrecognisedError(
            f"no output fits label space {space.name}: got {_list(candidates)}; expected "
            f"(B, C, h, w) class scores, C = {counts}, or (B, h, w) integer ids"
            f"{'' if classes else _hint(candidates, space)}"
        )
    usual = [key for key in ("out", "logits") if key in fitting]
    if len(fitting) > 1 and not usual:
        raise UnrecognisedError(
            f"several outputs could be labels: {_list(fitting)}; expected output: NAME"
        )
    chosen = usual[0] if len(fitting) > 1 else next(iter(fitting))
    if len(axes[chosen]) == 1:
        return chosen, axes[chosen][0]
    (height, width), (_, second, third, fourth) = size, fitting[chosen].shape
    sides = {1: (third, fourth), 3: (second, third)}
    proportional = [axis for axis, (h, w) in sides.items() if h * width == w * height]
    return chosen, proportional[0] if len(proportional) == 1 else 3 if channels_last else 1


def channel_counts(space: LabelSpace, classes: Classes = None) -> range:
    """The numbers of channels that a network's scores may have for a label space."""
    if classes is None:
        return space.channel_counts
    first, last = classes
    fits = last - first in space.channel_counts
    return range(last, 1 << 16) if fits else range(0)


def _class_axes(output: Tensor, space: LabelSpace, classes: Classes) -> Sequence[int | None]:
    """Which axes of an output, the second and the last of four, can be that of the classes, or
    ``None`` of ids without one; empty if it cannot hold labels."""
    if output.ndim != 4:
        return [None] if output.ndim == 3 and _holds_ids(output) else []
    counts = channel_counts(space, classes)
    if not output.is_floating_point():
        axes = [axis for axis in (1, 3) if output.shape[axis] == 1 and _holds_ids(output)]
        if axes or output.dtype not in _QUANTISED:
            return axes
    return [axis for axis in (1, 3) if output.shape[axis] in counts]


def scores_along(output: Tensor, axis: int | None, classes: Classes = None) -> Tensor:
    """Class scores ``(B, C, h, w)`` floats or ids ``(B, h, w)`` from an output and the axis of its
    classes, if it has one."""
    if axis is None:
        return output
    if not output.is_floating_point():
        if output.shape[axis] == 1:
            return output.squeeze(axis)
        output = output.float()  # quantised with one scale
    scores = output.movedim(axis, 1)
    return scores if classes is None else scores[:, slice(*classes)]


def batched(output: Tensor, numbers: Tensor) -> Tensor:
    """Ids ``(h, w)`` of an input of one picture as ``(1, h, w)``; other outputs stay. The number of
    pictures is not asked for these: `torch.export` would take it as fixed."""
    is_single = output.ndim == 2 and len(numbers) == 1 and len(output) > 1 and _holds_ids(output)
    return output[None] if is_single else output


def _holds_ids(output: Tensor) -> bool:
    is_number = not output.is_floating_point() and not output.is_complex()
    return is_number and output.dtype != torch.bool


def _hint(outputs: Mapping[str, Tensor], space: LabelSpace) -> str:
    """What to use where the network has more channels: a label space with so many, or the first."""
    most = max(space.channel_counts, default=0)
    scores = [x for x in outputs.values() if x.is_floating_point() and x.ndim == 4]
    counts = {tensor.shape[1] for tensor in scores if tensor.shape[1] > most}
    if not counts or not most:
        return ""
    fits = [n for n in label_space_names() if counts.intersection(label_space(n).channel_counts)]
    so_many = f"; so many has {' or '.join(fits)}" if fits else ""
    return f"{so_many}; classes: 0:{most} in a YAML file takes the first {most}"


def _list(outputs: Mapping[str, Tensor]) -> str:
    return ", ".join(
        f"{name} {tuple(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"
        for name, tensor in outputs.items()
    )


def classes_of(output: Tensor) -> Tensor:
    """The class of every pixel, ``(B, h, w)`` integers: of ``(B, C, h, w)`` scores the first of the
    largest, a NaN is a ValueError; ids stay. `Segmenter`, `SSRVLAD` and fused files use this rule.
    """
    return best_class(output) if output.is_floating_point() else output


def enlarged(labels: Tensor, height: int, width: int) -> Tensor:
    """``(B, h, w)`` label maps at another size, ``(B, height, width)``. Each pixel takes the label
    of the cell that contains its centre, in integer arithmetic: the same on every backend."""
    device = labels.device
    rows = (2 * torch.arange(height, device=device) + 1) * labels.shape[1] // (2 * height)
    columns = (2 * torch.arange(width, device=device) + 1) * labels.shape[2] // (2 * width)
    return labels.index_select(1, rows).index_select(2, columns)
