"""The exported file in OpenVINO on a CPU against the module; needs the extra openvino."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from cases import camvid_labels, degenerate, hand_drawn
from test_export import assert_equal, city, model_of, noise, of_preset, presets, random_blobs

openvino = pytest.importorskip("openvino", reason="the extra openvino is not installed")


@cache
def compiled(config):
    content = model_of(config).SerializeToString()
    core = openvino.Core()
    return core.compile_model(core.read_model(content), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})


def assert_parity(batch, config):
    assert_equal(list(compiled(config)({"labels": batch}).values()), batch, config)


@presets
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
    maps = [random_blobs(seed) for seed in range(100, 240)] + [noise(s) for s in range(100, 180)]
    maps += [*degenerate().values(), *hand_drawn().values(), *camvid_labels(4)]
    for labels in maps:
        assert_parity(labels[None], of_preset(preset))
    config = of_preset(preset, labels_as="cityscapes-trainids")
    for seed, size in ((5, (60, 81)), (6, (121, 160)), (7, (240, 320)), (8, (303, 211))):
        for labels in city(20, seed, size):
            assert_parity(labels[None], config)
