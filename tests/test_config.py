import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
from helpers import refuses

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.loops.config import LoopConfig


def test_presets_have_their_names_and_numbers():
    """Databases carry the fingerprints. Change them only with METHOD_REVISIONS or a setting."""
    fingerprints = {"paper": "fae2c61db07afbf9", "default": "e79189ee9e88a037"}
    for name in PRESETS:
        config = SSRVLADConfig.from_preset(name, labels_as="synthia")
        assert (config.preset, config.fingerprint) == (name, fingerprints[name])
    assert SSRVLADConfig(rings=4).preset == "custom"
    paper = SSRVLADConfig.from_preset("paper")
    assert (paper.rings, paper.sectors, paper.length, paper.working_size) == (5, 12, 480, None)


OTHER = {
    "working_size": 121,
    "opening": 0.02,
    "closing": 0.02,
    "hole_area": 0.1,
    "region_area": 0.1,
    "thinning": "guo-hall",
    "rings": 4,
    "sectors": 8,
    "radius": 0.4,
    "inner_radius": 0.1,
    "context": "keypoints",
    "aggregation": "residuals",
    "anchor": "middle",
    "harmonics": 30,
    "boundary_harmonics": 30,
    "spectral_weight": 0.5,
    "power": 0.5,
}


@pytest.mark.parametrize(
    ("aggregation", "unused"),
    [
        ("harmonics", {"opening", "closing", "hole_area", "region_area", "thinning", "context"}),
        ("residuals", {"anchor", "harmonics", "boundary_harmonics", "spectral_weight", "power"}),
    ],
)
def test_every_setting_that_matters_is_in_the_fingerprint(aggregation, unused):
    base = SSRVLADConfig(labels_as="camvid-11", sectors=22, aggregation=aggregation)
    assert set(base.to_dict()) == {"labels_as", *OTHER}
    (another,) = {"harmonics", "residuals"} - {aggregation}
    other = {**OTHER, "aggregation": another, "sectors": 21, "labels_as": "synthia"}
    changed = {k: dataclasses.replace(base, **{k: v}).fingerprint for k, v in other.items()}
    same = {name for name, fingerprint in changed.items() if fingerprint == base.fingerprint}
    assert same == unused | {"labels_as"}
    assert len(set(changed.values())) == len(changed) - len(same) + 1


@pytest.mark.parametrize(
    ("preset", "name", "value"),
    [("default", "power", 1), ("paper", "closing", 0), ("paper", "closing", -0.0)],
)
def test_equal_settings_have_one_fingerprint(preset, name, value):
    one = SSRVLADConfig.from_preset(preset, **{name: value})
    other = SSRVLADConfig.from_preset(preset, **{name: abs(float(value))})
    assert one == other
    assert one.fingerprint == other.fingerprint


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rings": 0}, "rings must be an integer from 1 to 64, got 0"),
        ({"sectors": 12.0}, r"sectors must be an integer from 1 to 360, got 12\.0"),
        ({"working_size": True}, "working_size must be an integer"),
        ({"closing": -0.1}, r"closing must be a fraction from 0 to 0\.5, got -0\.1"),
        ({"hole_area": float("nan")}, "hole_area must be a fraction"),
        ({"radius": 0}, "radius must be a fraction above 0"),
        ({"boundary_harmonics": 115}, "boundary_harmonics must be at most 114 with 6 rings and 20"),
        ({"thinning": "lee"}, "thinning must be one of zhang-suen, guo-hall, got 'lee'"),
        ({"context": "area"}, "context must be one of skeleton, keypoints, got 'area'"),
        ({"labels_as": 3}, "labels_as must be a name, a path or a LabelSpace, got 3"),
        ({"preset": "fast"}, "preset must be one of paper, default, got 'fast'"),
        ({"ring": 3}, "unknown setting 'ring'; the settings are aggregation, anchor"),
    ],
)
def test_bad_settings_are_refused_by_name(settings, message):
    refuses(message, SSRVLADConfig.from_preset, **{"preset": "default", **settings})


@pytest.mark.parametrize(
    ("image", "working_size", "grid"),
    [
        ((360, 480), 120, (120, 160)),
        ((1024, 1024), 120, (120, 120)),
        ((1024, 2048), 120, (120, 240)),
        ((480, 360), 120, (160, 120)),
        ((100, 300), 120, (100, 300)),
        ((721, 1283), 120, (120, 214)),
        ((360, 480), None, (360, 480)),
        ((1, 1), 1, (1, 1)),
    ],
)
def test_grid_keeps_the_aspect_and_never_enlarges(image, working_size, grid):
    assert SSRVLADConfig(working_size=working_size).grid(*image) == grid


def test_fractions_become_whole_pixels():
    config = SSRVLADConfig()
    assert config.radius_pixels(0.01, 360, 480) == 4
    assert config.radius_pixels(0.01, 120, 160) == 1
    assert config.radius_pixels(0.0, 360, 480) == 0
    assert config.area_pixels(0.001, 100, 100) == 10
    assert config.area_pixels(0.001, 100, 101) == 11  # 10 pixels are fewer than 10.1
    assert config.area_pixels(0.0, 100, 100) == 0


def test_rings_double_and_end_at_the_radius():
    limits = SSRVLADConfig.from_preset("paper", radius=0.5).ring_limits(300, 400)
    assert limits[-1] == 250**2
    assert [round((outer / inner) ** 0.5, 2) for inner, outer in pairwise(limits)] == [2] * 4
    one = SSRVLADConfig(rings=1, harmonics=1, boundary_harmonics=1)
    assert one.ring_limits(300, 400) == (250**2,)


# ---- of loops


def test_numbers_of_numpy_are_numbers():
    config = LoopConfig(exclude=np.int64(3), threshold=np.float32(0.5))
    assert config == LoopConfig(exclude=3, threshold=0.5) and type(config.exclude) is int


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exclude": -1}, "exclude: expected an integer from 0, got -1"),
        ({"exclude": 2.0}, "exclude: expected an integer"),
        ({"exclude": True}, "exclude: expected an integer"),
        ({"threshold": math.nan}, "threshold: expected a number from 0 to 1, got nan"),
        ({"threshold": 1.1}, "threshold: expected a number"),
        ({"threshold": None}, "threshold: expected a number"),
        ({"sweep": 1}, "sweep: expected a bool, got 1"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    refuses(message, LoopConfig, **settings)
