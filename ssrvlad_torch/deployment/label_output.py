"""The output of a segmentation graph that means labels, and the nodes that make them of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..segmentation.network_outputs import Form, choose_output
from ..taxonomy import LabelSpace
from .golden_image import BFLOAT16

if TYPE_CHECKING:
    import onnx

Arrays = Mapping[str, npt.NDArray[Any]]

_FLOATS = ("tensor(float)", "tensor(float16)", "tensor(double)")


class LabelOutput(NamedTuple):
    """The output that means labels.

    Attributes:
        name: of the output.
        kind: ``"scores"`` or ``"ids"``.
        axis: of the classes, or the one of length 1 beside ids; ``None`` for ``(B, h, w)``.
        dtype: of the labels that the head is given, ``"uint8"`` or ``"int64"``.
    """

    name: str
    kind: str
    axis: int | None
    dtype: str

    def labels(self, output: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """What `nodes` compute, in NumPy: ``(B, h, w)`` labels of the output's own size.

        Raises:
            ValueError: the scores hold NaN.
        """
        if self.kind == "scores":
            if np.isnan(output).any():
                raise ValueError(f"output {self.name} holds NaN scores; wanted none")
            return np.asarray(output.argmax(self.axis), self.dtype)
        ids = output if self.axis is None else output.squeeze(self.axis)
        return ids.astype(self.dtype)

    def nodes(self, prefix: str, given: str) -> tuple[list[onnx.NodeProto], list[onnx.TensorProto]]:
        """The nodes that make ``{prefix}labels`` of the output, and the tables that they read.

        Scores of half precision are cast to float32, which changes none; the largest wins, the
        first of equals. A cast at once behind a network that ONNX Runtime computes in float32
        would be dropped, and with it the rounding to half precision that makes scores equal: so
        an axis is put on before it.

        Args:
            prefix: of all new names.
            given: dtype of the output as ONNX Runtime spells it.
        """
        from onnx import helper, numpy_helper

        last, nodes = self.name, []
        steps = self._steps(half=given == "tensor(float16)")
        for number, (operator, attributes) in enumerate(steps, 1):
            made = f"{prefix}labels" if number == len(steps) else f"{prefix}labels_{number}"
            inputs = [last, f"{prefix}axis"] if operator in ("Squeeze", "Unsqueeze") else [last]
            nodes.append(helper.make_node(operator, inputs, [made], name=made, **attributes))
            last = made
        axis = (self.axis or 0) if self.kind == "ids" else 0
        table = numpy_helper.from_array(np.array([axis], np.int64), f"{prefix}axis")
        return nodes, [table] if any(table.name in node.input for node in nodes) else []

    def _steps(self, half: bool) -> list[tuple[str, dict[str, Any]]]:
        to_labels: tuple[str, dict[str, Any]] = ("Cast", {"to": _data_type(self.dtype)})
        if self.kind == "ids":
            return [to_labels] if self.axis is None else [("Squeeze", {}), to_labels]
        assert self.axis is not None
        if not half:
            return [("ArgMax", {"axis": self.axis, "keepdims": 0}), to_labels]
        return [
            ("Unsqueeze", {}),
            ("Cast", {"to": _data_type("float32")}),
            ("ArgMax", {"axis": self.axis + 1, "keepdims": 0}),
            ("Squeeze", {}),
            to_labels,
        ]


def find_label_output(
    session: Any, outputs: Arrays | None, space: LabelSpace, name: str | None
) -> LabelOutput:
    """The output of a graph that means labels.

    Args:
        session: of ONNX Runtime.
        outputs: what a run gave, by name, if the graph could be run; shapes are taken from it.
        space: label space of the classes.
        name: the output to take.

    Raises:
        ValueError: no output fits, or several do; or the class count is not known.
    """
    forms = {value.name: _form(value, outputs) for value in session.get_outputs()}
    taken = choose_output(forms, space, name)
    form = forms[taken]
    if form.shape is None:
        raise ValueError(f"output {taken} {form} has no declared rank; wanted (B, C, h, w)")
    if form.kind == "ids" and len(form.shape) == 3:
        return LabelOutput(taken, "ids", None, _dtype(form))
    counts = space.channel_counts if form.kind == "scores" else range(1, 2)
    axis = next((axis for axis in (1, 3) if form.shape[axis] in counts), None)
    if axis is None:
        raise ValueError(f"output {taken} {form} does not say how many classes it has")
    if form.kind == "ids":
        return LabelOutput(taken, "ids", axis, _dtype(form))
    dtype = "uint8" if len(space.classes) <= 256 else "int64"
    return LabelOutput(taken, "scores", axis, dtype)


def _dtype(form: Form) -> str:
    return "uint8" if form.dtype == "tensor(uint8)" else "int64"


def _form(value: Any, outputs: Arrays | None) -> Form:
    if value.type == BFLOAT16:
        raise ValueError(
            f"output {value.name} is bfloat16, which ONNX Runtime cannot give; "
            "wanted float32 or float16"
        )
    kind = "scores" if value.type in _FLOATS else ""
    if value.type.startswith(("tensor(int", "tensor(uint")):
        kind = "ids"
    if outputs is not None:
        return Form(outputs[value.name].shape, value.type, kind)
    lengths = (n if isinstance(n, int) and n > 0 else None for n in value.shape)
    return Form(tuple(lengths) or None, value.type, kind)


def _data_type(dtype: str) -> int:
    from onnx import helper

    return int(helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))
