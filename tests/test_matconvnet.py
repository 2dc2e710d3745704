"""Networks in MATLAB files, with their layers as structs and as objects."""

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import refused
from scipy.io import savemat

from ssrvlad_torch.baselines.matconvnet import read_matconvnet

WITH_OBJECTS = Path(__file__).with_name("with_objects.mat").read_bytes()
"""A MATLAB 7 file as NetVLAD's authors save theirs: the layers are a struct conv1_1 with weights, a
struct relu1_1 without, an object of layerVLAD and one of layerWholeL2Normalize, both saved as the
structs that their ``saveobj`` returns. Written with mat-io 1.0.2 (``saveobj_classes``)."""


def network(*layers: dict[str, object]) -> dict[str, object]:
    cell = np.empty((1, len(layers)), object)
    cell[0] = layers
    average = np.array([123, 117, 104], np.float32).reshape(1, 1, 3)
    return {"layers": cell, "meta": {"normalization": {"averageImage": average}}}


def layer(name: str, *arrays: np.ndarray) -> dict[str, object]:
    cell = np.empty((1, len(arrays)), object)
    cell[0] = arrays
    return {"type": "conv", "name": name, "weights": cell}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "net.mat"


def test_layers_that_are_structs(path):
    rng = np.random.default_rng(0)
    weight, bias = rng.random((3, 3, 2, 4)), rng.random((4, 1))
    layers = [layer("conv", weight, bias), {"type": "relu", "name": "relu"}, layer("empty")]
    savemat(path, {"net": network(*layers)})
    read = read_matconvnet(path)
    assert read.weights.keys() == {"conv"}
    np.testing.assert_array_equal(read.weights["conv"][0], weight.astype(np.float32))
    np.testing.assert_array_equal(read.weights["conv"][1], bias.astype(np.float32))
    assert read.average.tolist() == [123, 117, 104]


def test_layers_that_are_objects(path):
    path.write_bytes(WITH_OBJECTS)
    weights, average = read_matconvnet(path)
    assert weights.keys() == {"conv1_1", "vlad:core"}
    assign, minus_centres = weights["vlad:core"]
    numbers = np.arange(6, dtype=np.float32).reshape(1, 1, 3, 2)
    np.testing.assert_array_equal(assign, numbers)
    np.testing.assert_array_equal(minus_centres, -numbers)
    np.testing.assert_array_equal(weights["conv1_1"][0], numbers)
    assert average.tolist() == [123, 117, 104]


def test_of_a_whole_average_image_the_first_pixel_is_taken(path):
    image = np.zeros((4, 5, 3), np.float32)
    image[0, 0] = 1, 2, 3
    content = network() | {"meta": {"normalization": {"averageImage": image}}}
    savemat(path, {"net": content})
    assert read_matconvnet(path).average.tolist() == [1, 2, 3]


@pytest.mark.parametrize("content", [{"x": 1}, {"net": {"layers": 1}}, {"net": np.ones(3)}])
def test_another_matlab_file(content, path):
    savemat(path, content)
    with pytest.raises(ValueError, match=r"net\.mat must hold a MatConvNet network"):
        read_matconvnet(path)


VERSION_7_3 = (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM").ljust(1024, b"\0")
DAMAGED = WITH_OBJECTS[:300] + bytes([WITH_OBJECTS[300] ^ 0x55]) + WITH_OBJECTS[301:]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *((WITH_OBJECTS[:keep], r"net\.mat") for keep in (5, 130, 300, 900)),
        (DAMAGED, r"net\.mat is not a whole MATLAB file"),
        (VERSION_7_3, r"version 7\.3; save it again in MATLAB with -v7"),
    ],
)
def test_a_damaged_file_and_another_version(content, message, path):
    path.write_bytes(content)
    with refused(message):
        read_matconvnet(path)


def test_a_missing_file_and_a_missing_scipy(path, monkeypatch):
    with pytest.raises(FileNotFoundError):
        read_matconvnet(path)
    path.write_bytes(WITH_OBJECTS)
    monkeypatch.setitem(sys.modules, "scipy.io", None)
    with pytest.raises(ImportError, match=r"pip install ssrvlad-torch\[eval\]"):
        read_matconvnet(path)
