"""Exported heads as functions, sessions that run them, and files with another golden pair."""

import base64
import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import pytest
import torch
from drawings import SPACE, blobs
from helpers import write_image
from PIL import Image

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity, write_city
from ssrvlad_torch.deployment import export
from ssrvlad_torch.taxonomy import label_space

Maps = npt.NDArray[Any]
PRESETS = ("paper", "default")
FIXED = (1, 241, 317)
"""The shape of the input of a file of fixed size, which takes int32."""
SWEPT = (-8, -4, 0, 4, 8)
"""The middle of the usual sweep: each column is traced anew."""
presets = pytest.mark.parametrize("preset", PRESETS)
by_preset_and_input = pytest.mark.parametrize(
    ("preset", "given", "dtype"),
    [
        ("paper", "labels", "uint8"),
        ("default", "labels", "uint8"),
        ("default", "logits", None),
        pytest.param("default", "labels", "int64", marks=pytest.mark.slow),
        pytest.param("paper", "labels", "int64", marks=pytest.mark.slow),
        pytest.param("paper", "logits", None, marks=pytest.mark.slow),
    ],
)
"""What is done to an input is the same for both presets, and ``paper`` takes long to trace."""
GUO_HALL = "guo-hall, one ring, odd sectors, keypoints as context, only opened, on a grid"
CUSTOM: dict[str, dict[str, Any]] = {
    GUO_HALL: {
        "preset": "paper",
        "working_size": 50,
        "opening": 0.02,
        "thinning": "guo-hall",
        "rings": 1,
        "sectors": 5,
        "radius": 1.0,
        "context": "keypoints",
        "closing": 0.0,
        "hole_area": 0.0,
        "region_area": 0.0,
    },
    "much cleaned on a grid": {
        "preset": "paper",
        "working_size": 50,
        "opening": 0.02,
        "closing": 0.03,
        "hole_area": 0.2,
        "region_area": 0.1,
    },
    "one row of cells": {"preset": "default", "working_size": 1},
    "other harmonics, around the middle, at native size": {
        "preset": "default",
        "working_size": None,
        "anchor": "middle",
        "thinning": "guo-hall",
        "rings": 4,
        "sectors": 7,
        "harmonics": 9,
        "boundary_harmonics": 12,
        "power": 1.0,
        "spectral_weight": 0.0,
    },
}
RARE = (GUO_HALL, "much cleaned on a grid", "one row of cells")
"""Take a minute to trace, or run no code of a graph that the others do not."""


def of_preset(preset: str, **settings: Any) -> SSRVLADConfig:
    return SSRVLADConfig.from_preset(preset, **{"labels_as": SPACE, **settings})


def model_of(
    config: SSRVLADConfig,
    given: str = "labels",
    dtype: str | None = None,
    shape: tuple[int, int, int] | None = None,
) -> Any:
    return export.head_model(config, given, dtype, (), shape)


@cache
def run_of(config: SSRVLADConfig, *given: Any) -> Any:
    """The exported head as a function of a batch."""
    head = session(model_of(config, *given).SerializeToString())
    (value,) = head.get_inputs()
    return lambda batch: head.run(None, {value.name: batch})


def assert_parity(batch: Maps, config: SSRVLADConfig, given: str = "labels") -> None:
    """The file and the module agree on a batch."""
    dtype = "int64" if batch.dtype.kind == "i" else None
    assert_equal(run_of(config, given, dtype)(batch), batch, config)


def assert_equal(outputs: Sequence[Maps], batch: Maps, config: SSRVLADConfig) -> None:
    """Outputs of a file on some runtime are those of the module."""
    descriptor, unknown, *others = outputs
    view = SSRVLAD(config).explain(torch.tensor(batch))
    np.testing.assert_allclose(descriptor, view.descriptor, rtol=0, atol=1e-6)
    assert descriptor.dtype == np.float32
    assert not unknown.any()
    assert len(others) == (config.aggregation == "residuals")
    for keypoints in others:
        np.testing.assert_array_equal(keypoints, view.keypoints.sum((2, 3)))


def write_space(path: Path, *ids: int) -> Path:
    """A label space of classes with these ids."""
    rows = "\n".join(f"  - {{id: {n}, name: c{n}, category: ground}}" for n in ids)
    path.write_text(f"name: own\nsource: here\nclasses:\n{rows}\n")
    return path


def write_categories(path: Path, space: str) -> Path:
    """What the C core takes ids for."""
    categories = np.full(256, 255, np.uint8)
    for label in label_space(space).classes:
        categories[label.id] = label.category_index
    np.save(path, categories)
    return path


def noise(seed: int) -> Maps:
    """Regions of a few pixels, on a map of any shape."""
    rng = np.random.default_rng(seed)
    size = rng.integers(1, 80, 2)
    return rng.choice(rng.permutation(12)[: rng.integers(2, 5)], size).astype(np.uint8)


def random_blobs(seed: int) -> Maps:
    height, width = np.random.default_rng(seed).integers(8, 260, 2).tolist()
    return blobs(seed, height, width, 3 + seed % 29)


def city(frames: int, seed: int, size: tuple[int, int]) -> Iterator[Maps]:
    """Frames of the synthetic city, in ``cityscapes-trainids``."""
    for frame in SyntheticCity(seed=seed).traverse(
        frames, size=size, labels_as="cityscapes-trainids"
    ):
        yield frame.labels.astype(np.uint8)


def in_space(labels: Maps) -> Maps:
    """A frame of `city` with, for each class, the first of its category in ``SPACE``."""
    first = {each.category: each.id for each in reversed(label_space(SPACE).classes)}
    ids = np.zeros(256, np.uint8)
    for each in label_space("cityscapes-trainids").classes:
        ids[each.id] = first[each.category]
    return ids[labels]


def write_city_in_space(folder: Path, **settings: Any) -> Path:
    """`write_city`, in ``SPACE``, for which one head is traced for all tests."""
    for file in write_city(folder, **settings).glob("*/*.png"):
        write_image(file, in_space(np.asarray(Image.open(file))))
    return folder


def session(content: bytes, **options: Any) -> onnxruntime.InferenceSession:
    """A session with one thread on the CPU, without warnings."""
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    settings.log_severity_level = 3
    for name, value in options.items():
        setattr(settings, name, value)
    return onnxruntime.InferenceSession(content, settings, ["CPUExecutionProvider"])


def in_onnxruntime(model: onnx.ModelProto) -> Callable[..., list[Any]]:
    """A model as a function of its inputs in order."""
    runner = session(model.SerializeToString())
    names = [value.name for value in runner.get_inputs()]
    return lambda *inputs: runner.run(None, dict(zip(names, inputs, strict=True)))


def in_openvino(model: onnx.ModelProto) -> Callable[..., list[Any]]:
    """The same in OpenVINO, in single precision."""
    openvino = pytest.importorskip("openvino", reason="the extra openvino is not installed")
    core = openvino.Core()
    read = core.read_model(model.SerializeToString())
    compiled = core.compile_model(read, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    names = [value.name for value in model.graph.input]
    return lambda *inputs: list(compiled(dict(zip(names, inputs, strict=True))).values())


def edit_golden(source: Path, target: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A copy of an exported file with another golden pair."""
    model = onnx.load(source)
    (entry,) = (prop for prop in model.metadata_props if prop.key == "ssrvlad.golden")
    golden = json.loads(entry.value)
    change(golden)
    entry.value = json.dumps(golden)
    onnx.save(model, target)
    return target


def without_property(source: Path, target: Path, name: str) -> Path:
    """A copy of an exported file without one of its properties ``ssrvlad.*``."""
    model = onnx.load(source)
    (entry,) = (prop for prop in model.metadata_props if prop.key == f"ssrvlad.{name}")
    model.metadata_props.remove(entry)
    onnx.save(model, target)
    return target


def turned(name: str) -> Callable[[dict[str, Any]], None]:
    """For `edit_golden`: reverses the bytes of an array, so that a correct runtime looks wrong."""

    def turn(golden: dict[str, Any]) -> None:
        content = zlib.decompress(base64.b64decode(golden[name]["data"]))
        golden[name]["data"] = base64.b64encode(zlib.compress(content[::-1])).decode()

    return turn
