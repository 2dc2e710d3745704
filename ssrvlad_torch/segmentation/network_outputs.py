"""Outputs of segmentation networks: which of them, known by its shape, and what labels it means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..datasets.label_files import LabelMap
from ..taxonomy import LabelSpace

_USUAL_NAMES = ("out", "logits")


class Form(NamedTuple):
    """What is known of an output before or after the network has run.

    Attributes:
        shape: lengths of its axes, ``None`` where one is free; ``None`` where even their number is.
        dtype: in the words of the library that it is from.
        kind: ``"scores"`` if it holds floating numbers, ``"ids"`` for integers, or ``""``.
    """

    shape: tuple[int | None, ...] | None
    dtype: str
    kind: str

    def __str__(self) -> str:
        if self.shape is None:
            return f"(...) {self.dtype}"
        return f"({', '.join('?' if n is None else str(n) for n in self.shape)}) {self.dtype}"


def choose_output(forms: Mapping[str, Form], space: LabelSpace, name: str | None = None) -> str:
    """The name of the output that holds labels: class scores, or integer ids.

    Class scores are floats, ``(B, C, h, w)`` or ``(B, h, w, C)``, with a class count of the label
    space; ids are integers, ``(B, h, w)``, ``(B, 1, h, w)`` or ``(B, h, w, 1)``. Free axes fit
    anything. Of several that fit, one with the name ``out`` or ``logits`` is taken.

    Args:
        forms: the outputs by name.
        space: label space of the classes.
        name: the output to take.

    Raises:
        ValueError: none fits, or several do; the message has them all.
    """
    if name is not None and name not in forms:
        raise ValueError(f"there is no output {name!r}; the outputs are {_list(forms)}")
    at_hand = forms if name is None else {name: forms[name]}
    fitting = {key: form for key, form in at_hand.items() if _fits(form, space)}
    if not fitting:
        raise ValueError(
            f"no output fits label space {space.name}: got {_list(at_hand)}; wanted "
            f"(B, C, h, w) class scores, C = {_counts(space)}, or (B, h, w) integer ids"
        )
    usual = [key for key in _USUAL_NAMES if key in fitting]
    if len(fitting) > 1 and not usual:
        raise ValueError(f"several outputs could be labels: {_list(fitting)}; wanted output: NAME")
    return usual[0] if len(fitting) > 1 else next(iter(fitting))


def take_output(
    result: object, space: LabelSpace, name: str | None = None, channels_last: bool = False
) -> Tensor:
    """The output that holds labels, among all that a network gave.

    Args:
        result: a tensor, a mapping of names to tensors, an object with ``logits``, or a tuple,
            whose tensors are named ``0``, ``1`` and so on.
        space, name: as for `choose_output`.
        channels_last: which axis holds the classes should both be as long: the last, not the
            second.

    Returns:
        ``(B, C, h, w)`` floating class scores or ``(B, h, w)`` integer ids.

    Raises:
        ValueError: see `choose_output`.
    """
    tensors = dict(_named_tensors(result))
    forms = {key: _form(tensor) for key, tensor in tensors.items()}
    output = tensors[choose_output(forms, space, name)]
    if output.ndim == 3:
        return output
    counts = space.channel_counts if output.is_floating_point() else range(1, 2)
    axis = next(a for a in ((3, 1) if channels_last else (1, 3)) if output.shape[a] in counts)
    return output.movedim(axis, 1) if output.is_floating_point() else output.squeeze(axis)


def label_map(output: Tensor, size: tuple[int, int]) -> LabelMap:
    """The label map of one image.

    Scores are enlarged bilinearly, corners not aligned, and the largest wins, the first of
    equals; ids go by the nearest pixel. Classes are compared one after another, so that the
    enlarged scores of all are never in memory.

    Args:
        output: ``(C, h, w)`` class scores or ``(h, w)`` ids, from `take_output`.
        size: height and width of the label map.

    Returns:
        ``(H, W)`` of the narrowest of uint8, uint16 and int64.

    Raises:
        ValueError: scores hold NaN.
    """
    if not output.is_floating_point():
        plane = output[None, None].to(torch.float64)  # holds ids up to 2 ** 53
        resized = (
            plane if plane.shape[2:] == size else interpolate(plane, size, mode="nearest-exact")
        )
        return _narrowest(resized[0, 0].to(torch.int64))
    if bool(output.isnan().any()):
        raise ValueError(f"class scores hold {int(output.isnan().sum())} NaN values; wanted none")
    best = torch.full(size, -torch.inf, device=output.device)
    ids = torch.zeros(size, dtype=torch.int64, device=output.device)
    for label_id, scores in enumerate(output.float()):
        plane = scores
        if scores.shape != size:
            enlarged = interpolate(scores[None, None], size, mode="bilinear", align_corners=False)
            plane = enlarged[0, 0]
        better = plane > best
        best = torch.where(better, plane, best)
        ids.masked_fill_(better, label_id)
    return _narrowest(ids)


def _named_tensors(result: object) -> Iterator[tuple[str, Tensor]]:
    if isinstance(result, Tensor):
        named: Mapping[str, object] = {"output": result}
    elif isinstance(result, Mapping):
        named = result
    elif isinstance(result, tuple | list):
        named = {str(place): value for place, value in enumerate(result)}
    else:
        named = {"logits": getattr(result, "logits", None)}
    tensors = [(str(key), value) for key, value in named.items() if isinstance(value, Tensor)]
    if not tensors:
        raise ValueError(f"the network gives a {type(result).__name__} without tensors")
    yield from tensors


def _form(tensor: Tensor) -> Form:
    dtype = str(tensor.dtype).removeprefix("torch.")
    if tensor.is_floating_point():
        return Form(tuple(tensor.shape), dtype, "scores")
    integers = not tensor.is_complex() and tensor.dtype != torch.bool
    return Form(tuple(tensor.shape), dtype, "ids" if integers else "")


def _fits(form: Form, space: LabelSpace) -> bool:
    if not form.kind or form.shape is None:
        return bool(form.kind)
    if form.kind == "ids" and len(form.shape) == 3:
        return True
    if len(form.shape) != 4:
        return False
    counts = space.channel_counts if form.kind == "scores" else range(1, 2)
    _, second, third, last = form.shape
    free = second is None or (last is None and third is not None)  # h and w are free together
    return free or second in counts or last in counts


def _counts(space: LabelSpace) -> str:
    return " or ".join(map(str, space.channel_counts)) or "none, for its ids have gaps"


def _list(forms: Mapping[str, Form]) -> str:
    return ", ".join(f"{name} {form}" for name, form in forms.items())


def _narrowest(ids: Tensor) -> LabelMap:
    labels = ids.numpy(force=True)
    for dtype in (np.uint8, np.uint16):
        if labels.min() >= 0 and labels.max() <= np.iinfo(dtype).max:
            return labels.astype(dtype)
    return labels
