"""Pickled arrays: what is read, and what is refused before it runs."""

import collections
import io
import os
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.evaluation.object_arrays import PickledArray, load_object_array

PROTOCOLS = range(6)


def load(content):
    return load_object_array(io.BytesIO(content))


def plain(value):
    """Arrays, tuples and lists as lists."""
    if isinstance(value, PickledArray | list | tuple):
        return [plain(element) for element in value]
    return value


def array(elements, shape):
    """An array of objects, whatever the objects are."""
    table = np.empty(len(elements), object)
    for place, element in enumerate(elements):
        table[place] = element
    return table.reshape(shape)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_what_numpy_writes_is_read(protocol):
    table = array([0, [1, 2], 1, (), 2.5, np.array([3, 4]), np.int32(7), [np.float32(0.5)]], (4, 2))
    for layout in (table, np.asfortranarray(table)):
        found = load(pickle.dumps(layout, protocol))
        assert found.shape == (4, 2)
        assert plain(found) == [[0, [1, 2]], [1, []], [2.5, [3, 4]], [7, [0.5]]]
    for dtype in ("?", "u1", "<i2", ">i4", "i8", "f4", ">f8"):
        numbers = np.array([[0, 1, 1], [1, 0, 1]], dtype)
        found = load(pickle.dumps(array([numbers.T], 1), protocol)).values[0]
        assert (found.shape, found.values) == ((3, 2), numbers.T.ravel().tolist())


def test_python_2_wrote_bytes_as_text():
    """An ``array([258, 3], dtype='<i4')`` as Python 2 pickled it."""
    content = (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
        b"(I1\n(I2\ntcnumpy\ndtype\n(S'i4'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\n"
        b"S'\\x02\\x01\\x00\\x00\\x03\\x00\\x00\\x00'\ntb."
    )
    assert load(content).values == [258, 3]


ELEMENTS = st.recursive(
    st.integers(-(2**70), 2**70) | st.floats(allow_nan=False) | st.booleans(),
    lambda inner: st.lists(inner, max_size=4) | st.lists(inner, max_size=4).map(tuple),
    max_leaves=12,
)


@given(st.lists(ELEMENTS, max_size=6), st.sampled_from(PROTOCOLS))
def test_nested_elements_come_back(elements, protocol):
    found = load(pickle.dumps(array(elements, len(elements)), protocol))
    assert len(found) == len(elements)
    assert plain(found) == plain(elements)


class Calls:
    """Pickles as a call of a function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    ("element", "name"),
    [
        (Calls(os.system, "true"), "posix.system"),
        (Calls(eval, "1"), "builtins.eval"),
        (Calls(getattr, [], "append"), "builtins.getattr"),
        (Calls(np.load, "x"), "numpy.load"),
        (collections.Counter(), "collections.Counter"),
        (np.array(["text"]), r"numpy.dtype\('U4'\)"),
        (np.zeros(2, "i4,f4"), r"numpy.dtype\('V8'\)"),
        (np.array(["2020-01-01"], "M8[D]"), r"numpy.dtype\('M8'\)"),
        (os.system, "posix.system"),
        (np.ndarray.resize, "builtins.getattr"),
    ],
)
@pytest.mark.parametrize("protocol", [2, 4])
def test_any_other_name_is_refused(element, name, protocol):
    content = pickle.dumps(array([0, element], 2), protocol)
    content = content.replace(b"c__builtin__", b"cbuiltins")
    with pytest.raises(ValueError, match=f"refers to .*{name.split('.')[-1]}; expected only"):
        load(content)


def test_nothing_is_run(tmp_path):
    mark = tmp_path / "mark"
    content = pickle.dumps(array([Calls(os.system, f"touch {mark}")], 1))
    with pytest.raises(ValueError, match="system"):
        load(content)
    assert not mark.exists()
    dotted = b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93."
    with pytest.raises(ValueError, match=r"refers to numpy\.ndarray\.__class__"):
        load(dotted)


def test_a_pickle_cannot_change_what_the_next_one_meets():
    """BUILD sets any attribute of what GLOBAL gives; each GLOBAL must give something new."""
    poison = (
        b"cnumpy.core.multiarray\n_reconstruct\n(N}(S'__defaults__'\n(cnumpy\nndarray\ntS'x'\nI1\n"
        b"utb0cnumpy\nndarray\n(t(N}(S'__setstate__'\nI1\nutb."
    )
    with pytest.raises(ValueError, match="no complete pickle"):
        load(poison)
    assert load(pickle.dumps(array([1, [2]], 2))).values == [1, [2]]


def test_an_array_that_does_not_hold_what_its_shape_says():
    whole = pickle.dumps(array([1, 2, 3], 3), 2)
    assert load(whole).values == [1, 2, 3]
    with pytest.raises(ValueError, match=r"does not fit its shape \(9,\)"):
        load(whole.replace(b"K\x01K\x03\x85", b"K\x01K\x09\x85"))


@pytest.mark.parametrize(
    "content", [b"", b"no pickle", *map(pickle.dumps, (None, [1, 2], {}, "x"))]
)
def test_what_is_no_array_is_an_error(content):
    with pytest.raises(ValueError, match="pickle"):
        load(content)


@pytest.mark.parametrize("protocol", [2, 4])
def test_damage_is_one_line(protocol):
    """Any byte changed, or the end missing: an array or a ValueError, and nothing else."""
    whole = pickle.dumps(array([0, [1, 2], 1, np.array([3])], (2, 2)), protocol)
    rng = np.random.default_rng(0)
    damaged = [whole[:length] for length in range(len(whole))]
    for place in range(len(whole)):
        content = bytearray(whole)
        content[place] = rng.integers(0, 256)
        damaged.append(bytes(content))
    for content in damaged:
        try:
            assert isinstance(load(content), PickledArray)
        except ValueError as error:
            assert "\n" not in str(error).strip()


@pytest.mark.parametrize("put", [b"p9000000000\n", b"r\xff\xff\xff\x7f"])
def test_a_place_in_the_memo_that_takes_the_memory_is_refused(put):
    with pytest.raises(ValueError, match=r"no complete pickle: memo index \d+ at"):
        load(b"I1\n" + put + b".")
