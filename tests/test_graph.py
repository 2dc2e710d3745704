import numpy as np
import onnx
import pytest
import torch
from graphs import run

from ssrvlad_torch.deployment.graph import OPSET, Graph, Symbol


def arithmetic(graph: Graph, x: Symbol, y: Symbol) -> list[Symbol]:
    return [x + y, x - 3, 7 - x, x * y, 2 * x, x // y, 100 // y, x % y, 1 + x]


def test_arithmetic_on_whole_numbers():
    x, y = torch.tensor([9, 40, 7]), torch.tensor([2, 7, 9])
    expected = [x + y, x - 3, 7 - x, x * y, 2 * x, x // y, 100 // y, x % y, 1 + x]
    for got, target in zip(run(arithmetic, x, y), expected, strict=True):
        assert torch.equal(got, target)


def bitwise(graph: Graph, x: Symbol, y: Symbol, bits: Symbol) -> list[Symbol]:
    small = x.to("uint8")
    shifted = x.reshape(-1, 1) >> np.array([0, 3])
    return [x & y, x | y, x ^ y, ~x, x & 255, small & 7, x << 8, x << bits, x >> 16, shifted]


def test_bits_of_words():
    x, y, bits = torch.tensor([[1, (1 << 24) - 5, 77], [3, 1 << 23, 6], [22, 0, 9]])
    small = (x & 255).to(torch.uint8)
    shifted = x[:, None] >> torch.tensor([0, 3])
    moved = [(x << 8).int().long(), (x << bits).int().long(), x >> 16, shifted]
    expected = [x & y, x | y, x ^ y, ~x, x & 255, small & 7, *moved]
    for got, target in zip(run(bitwise, x, y, bits), expected, strict=True):
        assert torch.equal(got, target)


def divided(graph: Graph, number: Symbol, quotient: Symbol, divisor: Symbol) -> list[Symbol]:
    return list(graph.divided(number, quotient.to("float32"), divisor))


def test_numbers_that_overflow_are_divided_exactly():
    """By estimates that are right, too low or too high."""
    numbers = torch.tensor([7 * 10**15 + 5, 9 * 10**14, 10**9 - 1, 0])
    quotients, divisors = numbers // 10**9, torch.full((4,), 10**9)
    wrapped = torch.from_numpy(numbers.numpy().astype(np.int32))
    for estimate in (quotients, quotients - 1, quotients + 1):
        got = run(divided, wrapped, estimate, divisors)
        assert torch.equal(got[0].long(), quotients)
        assert torch.equal(got[1].long(), numbers % 10**9)


def compared(graph: Graph, x: Symbol, y: Symbol) -> list[Symbol]:
    less, equal = x < y, x.equals(y)
    return [less, x <= y, x > y, x >= 2, equal, less | equal, less & ~equal, less ^ equal]


def test_comparisons_and_truth():
    x, y = torch.tensor([1, 2, 3]), torch.tensor([2, 2, 2])
    less, equal = x < y, x == y
    expected = [less, x <= y, x > y, x >= 2, equal, less | equal, less & ~equal, less ^ equal]
    for got, target in zip(run(compared, x, y), expected, strict=True):
        assert torch.equal(got, target)


def lists(graph: Graph, values: Symbol, index: Symbol, times: Symbol) -> list[Symbol]:
    number, how_many_before = graph.repeated(times)
    return [
        values.take(index),
        values[1:],
        values[:-1],
        values[0],
        graph.sums(index, values, 9),
        graph.counts(index, graph.length(index)),
        graph.exclusive_sums(values),
        number,
        how_many_before,
        graph.any(values > 100),
        graph.any(values[:0] > 0),
        graph.arange(values[0]),
        graph.full([2, values[0]], 7, "uint8"),
        graph.like(values, 4, "int32"),
    ]


def test_lists():
    values, index = torch.tensor([5, 1, 4, 101]), torch.tensor([2, 0, 0, 3])
    got = run(lists, values, index, torch.tensor([0, 2, 0, 3, 0]))
    expected = [
        [4, 5, 5, 101],
        [1, 4, 101],
        [5, 1, 4],
        5,
        [5, 0, 5, 101, 0, 0, 0, 0, 0],
        [2, 0, 1, 1],
        [0, 5, 6, 10],
        [1, 1, 3, 3, 3],
        [0, 1, 0, 1, 2],
        True,
        False,
        [0, 1, 2, 3, 4],
        [[7] * 5] * 2,
        [4] * 4,
    ]
    assert [x.tolist() for x in got] == expected


@pytest.mark.parametrize("times", [[], [0], [0, 0]])
def test_nothing_is_repeated(times):
    got = run(lists, torch.tensor([5]), torch.tensor([0]), torch.tensor(times, dtype=torch.int64))
    assert got[7].tolist() == got[8].tolist() == []


def test_loops():
    def nested(graph: Graph, start: Symbol, trips: Symbol) -> list[Symbol]:
        def inner(step: Symbol, x: Symbol) -> list[Symbol]:
            return graph.repeat(step + 1, lambda _, y: [y + start * trips], x)

        doubled = graph.repeat(trips, lambda step, x: [x * 2 + step], start)
        halved = graph.repeat_while(lambda _, x, n: (x > 3, x // 2, n + 1), start, start * 0)
        return [*doubled, *halved, *graph.repeat(trips, inner, start)]

    got = run(nested, torch.tensor(5), torch.tensor(3))
    assert [x.tolist() for x in got] == [44, 1, 2, 95]
    got = run(nested, torch.tensor(5), torch.tensor(0))
    assert [x.tolist() for x in got] == [5, 1, 2, 5]


def model(build, **forms) -> onnx.ModelProto:
    graph = Graph(forms)
    return graph.model({"out": (build(graph, *graph.inputs), ("int32", ["N"]))})


def test_what_a_loop_does_not_change_is_computed_before_it():
    def build(graph: Graph, x: Symbol) -> Symbol:
        return graph.repeat(9, lambda step, y: [y + x * x % 7 + step], x)[0]

    built = model(build, x=("int32", ["N"]))
    (loop,) = (node for node in built.graph.node if node.op_type == "Loop")
    assert {node.op_type for node in loop.attribute[0].g.node} == {"Add", "Cast", "Identity"}
    assert {"Mul", "Mod"} <= {node.op_type for node in built.graph.node}


def test_a_model_is_valid_and_has_no_names_of_python():
    built = model(lambda graph, x: x + 1 + (x + 1), x=("int32", ["N"]))
    onnx.checker.check_model(built, full_check=True)
    assert [(each.domain, each.version) for each in built.opset_import] == [("", OPSET)]
    assert sum(node.op_type == "Add" for node in built.graph.node) == 2, "x + 1 stands once"
    assert not any(node.metadata_props for node in built.graph.node)


def test_equal_tables_are_stored_once():
    def build(graph: Graph, x: Symbol) -> Symbol:
        table = np.arange(5)
        return graph.constant(table).take(x) + graph.constant(table.copy()).take(x + 1)

    built = model(build, x=("int32", ["N"]))
    assert [len(each.dims) for each in built.graph.initializer].count(1) == 1


def test_a_symbol_has_no_truth():
    with pytest.raises(TypeError, match="no value before the graph runs"):
        bool(Graph({"x": ("bool", [])}).inputs[0])
