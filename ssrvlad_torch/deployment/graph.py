"""An ONNX graph under construction: expressions on symbols become its nodes.

A `Symbol` stands for a tensor, a `Graph` for the operators: ``graph.CumSum(x, 0)`` adds a node and
returns the symbol of its output, and so do the operators of Python, ``x & ~y``. So code that uses
Python's operators only, such as the thinning rules, runs on tensors and in a graph. A `Graph` needs
the extra ``onnx``; importing this module does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .trace import OPSET

if TYPE_CHECKING:
    import onnx
    import onnx_ir as ir

Form = tuple[str, Sequence[int | str]]
"""Dtype and shape of an input or output; an axis with a name is dynamic."""


def _operator(name: str, reflected: bool = False) -> Callable[[Symbol, Any], Symbol]:
    """An operator of Python that is a node of two inputs."""

    def node(symbol: Symbol, other: Symbol | float) -> Symbol:
        return symbol.graph.node(name, *((other, symbol) if reflected else (symbol, other)))

    return node


class Symbol:
    """A tensor of a `Graph`.

    Numbers in an expression take the dtype of the symbol. ``//`` and ``%`` round towards zero and
    ``>>`` is a division, so their numerators must not be negative. ``depth`` is the number of
    loops around the node that computes the symbol.
    """

    __slots__ = ("depth", "graph", "value")

    def __init__(self, graph: Graph, value: ir.Value, depth: int = 0) -> None:
        self.graph = graph
        self.value = value
        self.depth = depth

    @property
    def dtype(self) -> str:
        """NumPy's name of the dtype, such as ``"uint64"``."""
        assert self.value.dtype is not None, f"{self.value.name} has no dtype"
        return str(self.value.dtype.numpy().name)

    def to(self, dtype: str) -> Symbol:
        """The same numbers in another dtype."""
        return self if self.dtype == dtype else self.graph.Cast(self, to=_data_type(dtype))

    def reshape(self, *sizes: Symbol | int) -> Symbol:
        """The same numbers in another shape; a size may be -1."""
        return self.graph.Reshape(self, self.graph.vector(*sizes))

    def take(self, index: Symbol) -> Symbol:
        """``(n,)``, the entries of a ``(T,)`` table at an ``(n,)`` index."""
        return self.graph.GatherElements(self, index, axis=0)

    def __getitem__(self, part: Symbol | int | slice) -> Symbol:
        if not isinstance(part, slice):
            return self.graph.Gather(self, part, axis=0)
        begin = 0 if part.start is None else part.start
        end = np.iinfo(np.int64).max if part.stop is None else part.stop
        return self.graph.Slice(self, self.graph.vector(begin), self.graph.vector(end), [0])

    def __bool__(self) -> bool:
        raise TypeError(f"{self.value.name} has no value before the graph runs")

    def __and__(self, other: Symbol | int) -> Symbol:
        return self._bitwise("And", other)

    def __or__(self, other: Symbol | int) -> Symbol:
        return self._bitwise("Or", other)

    def __xor__(self, other: Symbol | int) -> Symbol:
        return self._bitwise("Xor", other)

    def __invert__(self) -> Symbol:
        return self._bitwise("Not")

    def __lshift__(self, bits: Symbol | int) -> Symbol:
        powers = self.graph.constant(1 << np.arange(31, dtype=np.int32))
        return self * (1 << bits if isinstance(bits, int) else powers.take(bits))

    def __rshift__(self, bits: int | npt.NDArray[np.int64]) -> Symbol:
        return self // self.graph.constant(np.left_shift(1, bits).astype(np.int32))

    __add__ = __radd__ = _operator("Add")
    __mul__ = __rmul__ = _operator("Mul")
    __sub__, __rsub__ = _operator("Sub"), _operator("Sub", reflected=True)
    __floordiv__ = __truediv__ = _operator("Div")
    __rfloordiv__ = _operator("Div", reflected=True)
    __mod__ = _operator("Mod")
    __lt__, __le__ = _operator("Less"), _operator("LessOrEqual")
    __gt__, __ge__ = _operator("Greater"), _operator("GreaterOrEqual")

    def equals(self, other: Symbol | int) -> Symbol:
        """bool, whether the numbers are equal."""
        return self.graph.Equal(self, other)

    def _bitwise(self, operator: str, *others: Symbol | int) -> Symbol:
        prefix = "" if self.dtype == "bool" else "Bitwise"
        return self.graph.node(prefix + operator, self, *others)


class Graph:
    """A graph whose methods are the ONNX operators: ``graph.Slice(x, [0], [9])`` adds a node.

    Args:
        inputs: forms of the inputs by name.

    Raises:
        ImportError: the extra ``onnx`` is not installed.
    """

    def __init__(self, inputs: Mapping[str, Form]) -> None:
        try:
            import onnx_ir as ir
            import onnxscript
        except ImportError as error:
            raise ImportError("ONNX graphs need: pip install ssrvlad-torch[onnx]") from error
        values = [
            ir.val(name, dtype=_data_type(dtype), shape=shape)
            for name, (dtype, shape) in inputs.items()
        ]
        self.inputs = [Symbol(self, value) for value in values]
        self._graph = ir.Graph(values, [], nodes=[], opset_imports={"": OPSET}, name="ssrvlad")
        self._builders = [onnxscript.GraphBuilder(self._graph)]
        self._tables: dict[tuple[Any, ...], Symbol] = {}
        self._loops = 0

    def __getattr__(self, operator: str) -> Callable[..., Symbol]:
        if not operator[0].isupper():
            raise AttributeError(operator)
        return partial(self.node, operator)

    def node(self, operator: str, *arguments: Any, **attributes: Any) -> Symbol:
        """Adds a node and returns its only output.

        A node that does not depend on a loop's state is placed before the loop.
        """
        return self._nodes(_depth(arguments), operator, 1, *arguments, **attributes)[0]

    def split(self, symbol: Symbol, parts: int, axis: int = 0) -> list[Symbol]:
        """Equal parts along an axis."""
        return self._nodes(symbol.depth, "Split", parts, symbol, axis=axis, num_outputs=parts)

    def _nodes(
        self, depth: int, operator: str, outputs: int, *arguments: Any, **attributes: Any
    ) -> list[Symbol]:
        inputs = [each.value if isinstance(each, Symbol) else each for each in arguments]
        values: Any = self._builders[depth].call_op(
            operator, inputs, attributes, version=OPSET, outputs=outputs
        )
        return [Symbol(self, value, depth) for value in (values if outputs > 1 else [values])]

    def constant(self, array: npt.NDArray[Any]) -> Symbol:
        """A constant table; equal tables are stored once."""
        import onnx_ir as ir

        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._tables:
            name = f"table_{len(self._tables)}"
            value = self._builders[0].initializer(ir.tensor(array, name=name), name, qualify=False)
            self._tables[key] = Symbol(self, value)
        return self._tables[key]

    def vector(self, *numbers: Symbol | int) -> Symbol:
        """``(n,)`` int64, the dtype of shapes: numbers and ``()`` or ``(m,)`` symbols,
        concatenated."""
        if all(isinstance(number, int) for number in numbers):
            return self.constant(np.array(numbers, np.int64))
        parts = [
            self.vector(number)
            if isinstance(number, int)
            else self.Reshape(number.to("int64"), [-1])
            for number in numbers
        ]
        return parts[0] if len(parts) == 1 else self.Concat(*parts, axis=0)

    def sizes(self, symbol: Symbol, rank: int) -> list[Symbol]:
        """The lengths of the axes, each ``()`` int32."""
        shape = self.Shape(symbol).to("int32")
        return [shape[axis] for axis in range(rank)]

    def length(self, entries: Symbol) -> Symbol:
        """``()`` int32, the number of entries."""
        return self.Size(entries).to("int32")

    def indices(self, flags: Symbol) -> Symbol:
        """``(n,)`` int32, the indices at which an ``(m,)`` tensor is not zero."""
        return self.NonZero(flags).reshape(-1).to("int32")

    def arange(self, stop: Symbol) -> Symbol:
        """``(stop,)`` int32: 0, 1, ..."""
        return self.Range(0, stop, 1)

    def full(self, sizes: Sequence[Symbol | int], number: int, dtype: str) -> Symbol:
        """A tensor filled with a number."""
        import onnx_ir as ir

        fill = ir.tensor(np.array([number], dtype))
        return self.ConstantOfShape(self.vector(*sizes), value=fill)

    def like(self, other: Symbol, number: int, dtype: str) -> Symbol:
        """A tensor filled with a number, of the shape of another tensor."""
        return self.full([self.Shape(other)], number, dtype)

    def any(self, flags: Symbol) -> Symbol:
        """``()`` bool, whether any of the ``(n,)`` flags is set; n can be 0."""
        return self.ReduceMax(self.Pad(flags.to("int32"), [0, 1]), keepdims=0) > 0

    def divided(
        self, number: Symbol, estimate: Symbol, divisor: Symbol | int
    ) -> tuple[Symbol, Symbol]:
        """Quotient, rounded down, and remainder of a number that int32 may not hold. The remainder
        of a guess is small, so it is exact in spite of the overflow, and corrects the guess.

        Args:
            number: ``(n,)`` int32, modulo 2 ** 32.
            estimate: ``(n,)`` float32, the quotient; rounded down it is off by at most 1.
            divisor: above 0, at most a billion.
        """
        guess = self.Floor(estimate).to("int32")
        rest = number - guess * divisor
        more, less = (rest - divisor >= 0).to("int32"), (rest < 0).to("int32")
        return guess + more - less, rest - (more - less) * divisor

    def normalised(self, vectors: Symbol) -> Symbol:
        """Vectors along the last axis, divided by their L2 norms; zeros stay zeros."""
        norms = self.Sqrt(self.ReduceSum(vectors * vectors, [-1]))
        return vectors / self.Max(norms, 1e-12)

    def sums(self, index: Symbol, amounts: Symbol, count: Symbol | int) -> Symbol:
        """``(count,)``, the sums of the amounts with the same index."""
        zeros = self.full([count], 0, amounts.dtype)
        return self.ScatterElements(zeros, index, amounts, axis=0, reduction="add")

    def counts(self, index: Symbol, count: Symbol | int) -> Symbol:
        """``(count,)`` int32, the number of occurrences of each number in the index."""
        return self.sums(index, self.like(index, 1, "int32"), count)

    def exclusive_sums(self, amounts: Symbol) -> Symbol:
        """``(n,)``, for each entry the sum of all amounts before it."""
        return self.CumSum(amounts, 0, exclusive=1)

    def repeated(self, times: Symbol) -> tuple[Symbol, Symbol]:
        """Repeats the number n ``times[n]`` times: ``(m,)`` int32, the numbers, and ``(m,)`` int32,
        for each entry the count of equal entries before it."""
        begin = self.exclusive_sums(self.Pad(times, [0, 1]))
        begin, total = begin[:-1], begin[-1]
        later = begin[1:]
        starts = self.sums(later, self.like(later, 1, "int32"), total + 1)
        number = self.CumSum(starts[:total], 0)
        return number, self.arange(total) - begin.take(number)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Prefixes the names of the nodes that the body adds."""
        for builder in self._builders:
            builder.push_module(name)
        yield
        for builder in self._builders:
            builder.pop_module()

    def repeat(
        self,
        trips: Symbol | int,
        body: Callable[..., Sequence[Symbol]],
        *carried: Symbol,
        rank: int = 1,
    ) -> list[Symbol]:
        """``carried = body(step, *carried)``, ``trips`` times; all have the given rank."""
        return self._loop(trips, body, carried, False, rank)

    def repeat_while(self, body: Callable[..., Sequence[Symbol]], *carried: Symbol) -> list[Symbol]:
        """``going, *carried = body(step, *carried)``, once and while ``going`` is true; all have
        rank 1."""
        return self._loop(None, body, carried, True)

    def model(self, outputs: Mapping[str, tuple[Symbol, Form]]) -> onnx.ModelProto:
        """The finished graph.

        Args:
            outputs: symbol and form of each output by name.
        """
        import onnx_ir as ir
        from onnx_ir.passes import common

        for name, (symbol, (dtype, shape)) in outputs.items():
            output = self.node("Identity", symbol.to(dtype)).value
            output.name, output.shape = name, ir.Shape(shape)
            self._graph.outputs.append(output)
        model = ir.Model(self._graph, ir_version=8)
        passes = (
            common.CommonSubexpressionEliminationPass(),
            common.RemoveUnusedNodesPass(),
            common.ClearMetadataAndDocStringPass(),
        )
        for each in passes:
            each(model)
        return ir.to_proto(model)

    def _loop(
        self,
        trips: Symbol | int | None,
        body: Callable[..., Sequence[Symbol]],
        carried: Sequence[Symbol],
        going: bool,
        rank: int = 1,
    ) -> list[Symbol]:
        import onnx_ir as ir
        import onnxscript

        self._loops += 1
        name, depth = f"loop_{self._loops}", len(self._builders)
        dtypes = (_data_type(symbol.dtype) for symbol in carried)
        declared = [
            ir.val(f"{name}.step", ir.DataType.INT64, []),
            ir.val(f"{name}.going", ir.DataType.BOOL, []),
            *(
                ir.val(f"{name}.carried_{number}", dtype, ir.Shape([None] * rank))
                for number, dtype in enumerate(dtypes)
            ),
        ]
        subgraph = ir.Graph(declared, [], nodes=[], opset_imports={"": OPSET}, name=name)
        self._builders.append(onnxscript.GraphBuilder(subgraph, parent=self._builders[-1]))
        self._builders[-1].push_module(name)
        step, always, *state = (Symbol(self, value, depth) for value in declared)
        results = list(body(step.to("int32"), *state))
        if not going:
            results.insert(0, always)
        for result in results:
            is_local = result.depth == depth and result.value.producer() is not None
            output = result if is_local else self._nodes(depth, "Identity", 1, result)[0]
            subgraph.outputs.append(output.value)
        self._builders.pop()
        times = trips.to("int64") if isinstance(trips, Symbol) else trips
        symbols = self._nodes(depth - 1, "Loop", len(carried), times, True, *carried, body=subgraph)
        for symbol, result in zip(symbols, results[1:], strict=True):
            symbol.value.dtype = _data_type(result.dtype)
        return symbols


def _depth(arguments: Sequence[Any]) -> int:
    return max((each.depth for each in arguments if isinstance(each, Symbol)), default=0)


def _data_type(dtype: str) -> ir.DataType:
    import onnx_ir as ir

    return ir.DataType.from_numpy(np.dtype(dtype))
