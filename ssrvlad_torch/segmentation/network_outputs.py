"""Outputs of segmentation networks: which of them holds labels, and the class of every pixel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..stages.layers import best_class
from ..taxonomy import LabelSpace

Classes = tuple[int, int] | None
"""First channel of the scores that is taken and the one after the last; ``None`` for all."""

_USUAL_NAMES = ("out", "logits")


class UnrecognisedError(ValueError):
    """No output of a network holds labels, or several could."""


class Form(NamedTuple):
    """What is known of an output before or after the network has run.

    Attributes:
        shape: lengths of its axes, ``None`` where one is free; ``None`` where even their number is.
        dtype: as the library calls it.
        kind: ``"scores"`` for floating numbers, ``"ids"`` for integers, or ``""``.
    """

    shape: tuple[int | None, ...] | None
    dtype: str
    kind: str

    def __str__(self) -> str:
        if self.shape is None:
            return f"(...) {self.dtype}"
        return f"({', '.join('?' if n is None else str(n) for n in self.shape)}) {self.dtype}"


def choose_output(
    forms: Mapping[str, Form], space: LabelSpace, name: str | None = None, classes: Classes = None
) -> str:
    """The name of the output that holds labels: class scores, or integer ids.

    Class scores are floats, ``(B, C, h, w)`` or ``(B, h, w, C)``, with a class count of the label
    space; ids are integers, ``(B, h, w)``, ``(B, 1, h, w)`` or ``(B, h, w, 1)``. Free axes fit
    anything. Of several that fit, one with the name ``out`` or ``logits`` is taken.

    Args:
        forms: the outputs by name.
        space: label space of the classes.
        name: the output to take.
        classes: the channels to take, which then must be a class count of the label space.

    Raises:
        UnrecognisedError: none fits, or several do; the message has them all.
    """
    if name is not None and name not in forms:
        raise UnrecognisedError(f"there is no output {name!r}; the outputs are {_list(forms)}")
    at_hand = forms if name is None else {name: forms[name]}
    fitting = {key: form for key, form in at_hand.items() if _fits(form, space, classes)}
    if not fitting:
        raise UnrecognisedError(
            f"no output fits label space {space.name}: got {_list(at_hand)}; expected "
            f"(B, C, h, w) class scores, C = {_counts(space, classes)}, or (B, h, w) integer ids"
            f"{_hint(at_hand, space, classes)}"
        )
    usual = [key for key in _USUAL_NAMES if key in fitting]
    if len(fitting) > 1 and not usual:
        raise UnrecognisedError(
            f"several outputs could be labels: {_list(fitting)}; expected output: NAME"
        )
    return usual[0] if len(fitting) > 1 else next(iter(fitting))


def take_output(
    result: object,
    space: LabelSpace,
    name: str | None = None,
    classes: Classes = None,
    channels_last: bool = False,
) -> Tensor:
    """The output that holds labels, among all that a network gave.

    Args:
        result: a tensor, a mapping of names to tensors, an object with ``logits``, or a tuple,
            whose tensors are named ``0``, ``1`` and so on.
        space, name, classes: as for `choose_output`.
        channels_last: which axis holds the classes should both be as long: the last, not the
            second.

    Returns:
        ``(B, C, h, w)`` floating class scores or ``(B, h, w)`` integer ids.

    Raises:
        UnrecognisedError: see `choose_output`.
    """
    tensors = dict(_named_tensors(result))
    forms = {key: _form(tensor) for key, tensor in tensors.items()}
    output = tensors[choose_output(forms, space, name, classes)]
    if output.ndim == 3:
        return output
    if not output.is_floating_point():
        return output.squeeze(class_axis(output.shape, range(1, 2), channels_last))
    scores = output.movedim(
        class_axis(output.shape, channel_counts(space, classes), channels_last), 1
    )
    return scores if classes is None else scores[:, slice(*classes)]


def channel_counts(space: LabelSpace, classes: Classes = None) -> range:
    """How many channels the scores of a network may have for a label space."""
    if classes is None:
        return space.channel_counts
    first, last = classes
    fits = last - first in space.channel_counts
    return range(last, 1 << 16) if fits else range(0)


def class_axis(shape: tuple[int | None, ...], counts: range, channels_last: bool) -> int:
    """The axis of an output that holds the classes: the second or the last."""
    order = (3, 1) if channels_last else (1, 3)
    return next(axis for axis in order if shape[axis] in counts)


def classes_of(output: Tensor) -> Tensor:
    """The one rule of which class a pixel is: the largest score wins, the first of equals.
    `Segmenter`, `SSRVLAD` on class scores and the files of `fuse` all use it.

    Args:
        output: ``(B, C, h, w)`` floating class scores, or ``(B, h, w)`` ids, which stay.

    Returns:
        ``(B, h, w)`` integers.

    Raises:
        ValueError: a score is NaN. A graph cannot raise: there NaN goes unnoticed.
    """
    if not output.is_floating_point():
        return output
    return output.argmax(1) if torch.compiler.is_exporting() else best_class(output)


def enlarged(labels: Tensor, height: int, width: int) -> Tensor:
    """``(B, height, width)``: label maps ``(B, h, w)`` at another size. Each pixel takes the label
    of the cell that its middle is in; integers only, so that every backend gives the same
    pixels."""
    device = labels.device
    rows = (2 * torch.arange(height, device=device) + 1) * labels.shape[1] // (2 * height)
    columns = (2 * torch.arange(width, device=device) + 1) * labels.shape[2] // (2 * width)
    return labels.index_select(1, rows).index_select(2, columns)


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
        raise UnrecognisedError(f"the network gives a {type(result).__name__} without tensors")
    yield from tensors


def _form(tensor: Tensor) -> Form:
    dtype = str(tensor.dtype).removeprefix("torch.")
    if tensor.is_floating_point():
        return Form(tuple(tensor.shape), dtype, "scores")
    integers = not tensor.is_complex() and tensor.dtype != torch.bool
    return Form(tuple(tensor.shape), dtype, "ids" if integers else "")


def _fits(form: Form, space: LabelSpace, classes: Classes) -> bool:
    if not form.kind or form.shape is None:
        return bool(form.kind)
    if form.kind == "ids" and len(form.shape) == 3:
        return True
    if len(form.shape) != 4:
        return False
    counts = channel_counts(space, classes) if form.kind == "scores" else range(1, 2)
    _, second, third, last = form.shape
    free = second is None or (last is None and third is not None)  # h and w are free together
    return free or second in counts or last in counts


def _counts(space: LabelSpace, classes: Classes) -> str:
    counts = " or ".join(map(str, space.channel_counts)) or "none, for its ids have gaps"
    return counts if classes is None else f"{counts} of channels {classes[0]}:{classes[1]}"


def _hint(forms: Mapping[str, Form], space: LabelSpace, classes: Classes) -> str:
    """What to do where the network has more channels than the label space has classes."""
    most = max(space.channel_counts, default=0)
    more = any(
        form.kind == "scores"
        and form.shape
        and len(form.shape) == 4
        and (form.shape[1] or 0) > most
        for form in forms.values()
    )
    return f"; --classes 0:{most} takes the first {most}" if more and most and not classes else ""


def _list(forms: Mapping[str, Form]) -> str:
    return ", ".join(f"{name} {form}" for name, form in forms.items())
