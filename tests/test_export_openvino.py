"""The exported file in OpenVINO on a CPU against the module; needs the extra openvino."""

from functools import cache

import numpy as np
import pytest
from cases import camvid_labels, degenerate, hand_drawn
from exported import (
    assert_equal,
    hundreds_of_label_maps,
    model_of,
    noise,
    of_preset,
    presets,
    random_blobs,
)

openvino = pytest.importorskip("openvino", reason="the extra openvino is not installed")


@cache
def compiled(config):
    content = model_of(config).SerializeToString()
    core = openvino.Core()
    return core.compile_model(core.read_model(content), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})


def assert_parity(batch, config):
    assert_equal(list(compiled(config)({"labels": batch}).values()), batch, config)


@pytest.mark.parametrize("preset", [pytest.param("paper", marks=pytest.mark.slow), "default"])
def test_some_label_maps(preset):
    config = of_preset(preset)
    drawn = {**degenerate(), **hand_drawn()}
    for labels in (*drawn.values(), random_blobs(1), noise(3), *camvid_labels(300)):
        assert_parity(labels[None], config)


@presets
def test_a_batch_and_unknown_ids(preset):
    config = of_preset(preset)
    batch = np.stack([random_blobs(seed)[:90, :60] for seed in (4, 4)])
    assert_parity(batch, config)
    batch[1, :5, :7] = 200
    assert compiled(config)({"labels": batch})[1].tolist() == [0, 35]


@pytest.mark.slow
@presets
def test_hundreds_of_label_maps(preset):
    for space, maps in hundreds_of_label_maps().items():
        for labels in maps:
            assert_parity(labels[None], of_preset(preset, labels_as=space))
