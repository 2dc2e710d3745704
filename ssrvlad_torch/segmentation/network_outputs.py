"""Outputs of segmentation networks: which output holds labels, and the class of every pixel."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..stages.layers import best_class
from ..taxonomy import LabelSpace, label_space, label_space_names

Classes = tuple[int, int] | None
"""The first channel of the scores to use and the one after the last; ``None`` for all."""


class UnrecognisedError(ValueError):
    """No output of a network can be labels, or several can."""


class OutputForm(NamedTuple):
    """What is known of an output, declared or actual: its shape, ``None`` for a free axis or for a
    free number of axes; its dtype, by the library's name; and its kind, ``"scores"`` for floating
    numbers, ``"ids"`` for integers, or ``""``."""

    shape: tuple[int | None, ...] | None
    dtype: str
    kind: str

    def __str__(self) -> str:
        if self.shape is None:
            return f"(...) {self.dtype}"
        return f"({', '.join('?' if n is None else str(n) for n in self.shape)}) {self.dtype}"


def choose_output(
    forms: Mapping[str, OutputForm],
    space: LabelSpace,
    name: str | None = None,
    classes: Classes = None,
) -> str:
    """The name of the output that holds labels, class scores or integer ids; if a ``name`` is
    given, only that output can. If none does, or several could, an UnrecognisedError lists them.

    Class scores are floats, ``(B, C, h, w)`` or ``(B, h, w, C)``, with as many channels, or as many
    to use, as the label space has classes; ids are integers, ``(B, h, w)``, ``(B, 1, h, w)`` or
    ``(B, h, w, 1)``. Free axes fit any number. If several outputs fit, one named ``out`` or
    ``logits`` is chosen.
    """
    if name is not None and name not in forms:
        raise UnrecognisedError(f"there is no output {name!r}; the outputs are {_list(forms)}")
    candidates = forms if name is None else {name: forms[name]}
    fitting = {key: form for key, form in candidates.items() if _fits(form, space, classes)}
    if not fitting:
        counts = " or ".join(map(str, space.channel_counts)) or "none, for its ids have gaps"
        counts += f" of channels {classes[0]}:{classes[1]}" if classes else ""
        raise UnrecognisedError(
            f"no output fits label space {space.name}: got {_list(candidates)}; expected "
            f"(B, C, h, w) class scores, C = {counts}, or (B, h, w) integer ids"
            f"{_hint(candidates, space, classes)}"
        )
    usual = [key for key in ("out", "logits") if key in fitting]
    if len(fitting) > 1 and not usual:
        raise UnrecognisedError(
            f"several outputs could be labels: {_list(fitting)}; expected output: NAME"
        )
    return usual[0] if len(fitting) > 1 else next(iter(fitting))


def tensors_of(result: object) -> dict[str, Tensor]:
    """The tensors in the result of a network by name: a tensor, a mapping of names to tensors, an
    object with ``logits``, or a tuple, whose tensors are named ``0``, ``1`` and so on. A result
    without tensors is an UnrecognisedError."""
    if isinstance(result, Tensor):
        named: Mapping[object, object] = {"output": result}
    elif isinstance(result, Mapping):
        named = result
    elif isinstance(result, tuple | list):
        named = dict(enumerate(result))
    else:
        named = {"logits": getattr(result, "logits", None)}
    tensors = {str(key): value for key, value in named.items() if isinstance(value, Tensor)}
    if not tensors:
        raise UnrecognisedError(f"the network gives a {type(result).__name__} without tensors")
    return tensors


def channel_counts(space: LabelSpace, classes: Classes = None) -> range:
    """The numbers of channels that a network's scores may have for a label space."""
    if classes is None:
        return space.channel_counts
    first, last = classes
    fits = last - first in space.channel_counts
    return range(last, 1 << 16) if fits else range(0)


def class_axis(form: OutputForm, space: LabelSpace, classes: Classes = None) -> int | None:
    """The axis of an output of four axes that holds the classes, the second or the last, or
    ``None`` if its shape does not tell."""
    assert form.shape is not None
    counts = channel_counts(space, classes) if form.kind == "scores" else range(1, 2)
    fitting = [axis for axis in (1, 3) if form.shape[axis] in counts]
    _, second, third, last = form.shape
    half_free = None in (second, last) and third is not None  # h and w are free together
    return fitting[0] if len(fitting) == 1 and not half_free else None


def classes_of(output: Tensor) -> Tensor:
    """The class of every pixel, ``(B, h, w)`` integers: the largest score of ``(B, C, h, w)``
    floats wins, the first of equal ones; ``(B, h, w)`` ids stay. `Segmenter`, `SSRVLAD` on class
    scores and the files of `fuse` all use this rule. A NaN is a ValueError; a graph cannot raise,
    and does not detect it."""
    return best_class(output) if output.is_floating_point() else output


def enlarged(labels: Tensor, height: int, width: int) -> Tensor:
    """``(B, h, w)`` label maps at another size, ``(B, height, width)``. Each pixel takes the label
    of the cell that contains its centre, in integer arithmetic: the same on every backend."""
    device = labels.device
    rows = (2 * torch.arange(height, device=device) + 1) * labels.shape[1] // (2 * height)
    columns = (2 * torch.arange(width, device=device) + 1) * labels.shape[2] // (2 * width)
    return labels.index_select(1, rows).index_select(2, columns)


def form_of(tensor: Tensor) -> OutputForm:
    """The form of an actual output."""
    dtype = str(tensor.dtype).removeprefix("torch.")
    if tensor.is_floating_point():
        return OutputForm(tuple(tensor.shape), dtype, "scores")
    integers = not tensor.is_complex() and tensor.dtype != torch.bool
    return OutputForm(tuple(tensor.shape), dtype, "ids" if integers else "")


def _fits(form: OutputForm, space: LabelSpace, classes: Classes) -> bool:
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


def _hint(forms: Mapping[str, OutputForm], space: LabelSpace, classes: Classes) -> str:
    """What to use if the network has more channels than the label space has classes: a label space
    with so many, or the option that takes the first."""
    most = max(space.channel_counts, default=0)
    shapes = [form.shape for form in forms.values() if form.kind == "scores" and form.shape]
    more = {shape[1] or 0 for shape in shapes if len(shape) == 4 and (shape[1] or 0) > most}
    if not more or not most or classes:
        return ""
    fits = [n for n in label_space_names() if more.intersection(label_space(n).channel_counts)]
    so_many = f"; so many has {' or '.join(fits)}" if fits else ""
    return f"{so_many}; --classes 0:{most} takes the first {most}"


def _list(forms: Mapping[str, OutputForm]) -> str:
    return ", ".join(f"{name} {form}" for name, form in forms.items())
