"""The layout of Cityscapes."""

import json
import math

import numpy as np
import pytest
from helpers import refused, write_street
from trees import outline, plant, write

from ssrvlad_torch.datasets.cityscapes import read_fix
from ssrvlad_torch.datasets.layouts import open_dataset

FIX = {
    "gpsHeading": 281,
    "gpsLatitude": 50.780881831805594,
    "gpsLongitude": 6.108147476339736,
    "outsideTemperature": 17.5,
    "speed": 10.81953125,
    "yawRate": 0.171875,
}
FRAMES = {
    "train/aachen": ("aachen_000000_000019", "aachen_000001_000019", "aachen_000010_000019"),
    "val/frankfurt": ("frankfurt_000000_000294", "frankfurt_000000_000576"),
    "test/berlin": ("berlin_000000_000019",),
}


@pytest.fixture
def tree(tmp_path):
    root = tmp_path / "cityscapes"
    for city, names in FRAMES.items():
        for name in names:
            plant(root, f"leftImg8bit/{city}/{name}_leftImg8bit.png")
            write_street(root / f"gtFine/{city}/{name}_gtFine_labelIds.png", 0)
            plant(root, f"gtFine/{city}/{name}_gtFine_color.png")
            write(root / f"gtFine/{city}/{name}_gtFine_polygons.json", "{}")
            write(root / f"vehicle/{city}/{name}_vehicle.json", json.dumps(FIX))
    return root


def test_a_traverse_is_a_city(tree):
    dataset = open_dataset(tree)
    assert (dataset.layout, dataset.labels_as) == ("cityscapes", "cityscapes-ids")
    assert outline(dataset) == {
        city.replace("/", "-"): list(names) for city, names in sorted(FRAMES.items())
    }
    frame = next(dataset.select(["val-*"]).frames)
    assert frame.frame == "val-frankfurt/frankfurt_000000_000294"
    assert frame.image.name == "frankfurt_000000_000294_leftImg8bit.png"
    assert frame.label.name == "frankfurt_000000_000294_gtFine_labelIds.png"
    assert frame.has_pose
    assert dataset.truth is None
    assert dataset.warnings == []


def test_train_ids_are_read_when_asked_for_or_alone(tree):
    name = FRAMES["train/aachen"][0]
    city = tree / "gtFine" / "train" / "aachen"
    write_street(city / f"{name}_gtFine_labelTrainIds.png", 1)
    assert open_dataset(tree).labels_as == "cityscapes-ids"
    asked = open_dataset(tree, labels_as="cityscapes-trainids")
    assert [file.path.name for file in asked.label_files()] == [f"{name}_gtFine_labelTrainIds.png"]
    for path in tree.rglob("*_labelIds.png"):
        path.unlink()
    alone = open_dataset(tree)
    assert alone.labels_as == "cityscapes-trainids"
    assert alone.warnings == [
        "5 of 6 frames have no label map, the first is test-berlin/berlin_000000_000019"
    ]


def test_coarse_annotations_fill_what_is_not_fine(tree):
    fine, coarse = FRAMES["train/aachen"][0], FRAMES["train/aachen"][1]
    folder = tree / "gtFine" / "train" / "aachen"
    (folder / f"{coarse}_gtFine_labelIds.png").unlink()
    for name in (fine, coarse):
        place = f"gtCoarse/train/aachen/{name}_gtCoarse_labelIds.png"
        write_street(tree / place, 0)
    labels = {file.name: file.path.parents[2].name for file in open_dataset(tree).label_files()}
    assert (labels[fine], labels[coarse]) == ("gtFine", "gtCoarse")


def test_what_is_missing_is_said(tree):
    (tree / "vehicle" / "val" / "frankfurt" / "frankfurt_000000_000294_vehicle.json").unlink()
    (tree / "leftImg8bit" / "test" / "berlin" / "berlin_000000_000019_leftImg8bit.png").unlink()
    assert open_dataset(tree).warnings == [
        "1 of 6 frames have no image, the first is test-berlin/berlin_000000_000019",
        "1 of 6 frames have no pose, the first is val-frankfurt/frankfurt_000000_000294",
    ]
    (tree / "vehicle").rename(tree / "elsewhere")
    assert open_dataset(tree).warnings[0] == (
        f"{tree} has no vehicle/, so no frame has a pose; it is vehicle_trainvaltest.zip at "
        "cityscapes-dataset.com"
    )


# ---- GPS fixes


def fix(tmp_path, latitude, longitude, **others):
    content = {"gpsLatitude": latitude, "gpsLongitude": longitude, **others}
    return read_fix(write(tmp_path / "a_vehicle.json", json.dumps(content)))


def test_on_the_meridian_north_is_y(tmp_path):
    """A degree of a circle around a sphere of 6371 km is 111.195 km."""
    assert fix(tmp_path, 50, 9)[:2] == pytest.approx((0, 50 * 111_194.93), abs=1)
    assert fix(tmp_path, 0, 10)[0] == pytest.approx(111_194.93, rel=1e-3)


@pytest.mark.parametrize(
    ("course", "heading"),
    [(0, math.pi / 2), (90, 0), (180, -math.pi / 2), (281, math.radians(169))],
)
def test_courses_become_headings(tmp_path, course, heading):
    assert fix(tmp_path, 50, 9, gpsHeading=course).heading == pytest.approx(heading)


def test_a_course_may_be_left_out(tmp_path):
    assert math.isnan(fix(tmp_path, 50, 9).heading)


def test_distances_are_those_on_the_sphere(tmp_path):
    """Between fixes some metres apart anywhere in the data set's cities, against haversines."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        latitude, longitude = rng.uniform(47, 54), rng.uniform(6, 14)
        north, east = rng.uniform(-1e-3, 1e-3, 2)
        x, y = np.subtract(
            fix(tmp_path, latitude + north, longitude + east)[:2],
            fix(tmp_path, latitude, longitude)[:2],
        )
        first, second = math.radians(latitude), math.radians(latitude + north)
        sines = math.sin(math.radians(north) / 2) ** 2
        sines += math.cos(first) * math.cos(second) * math.sin(math.radians(east) / 2) ** 2
        expected = 2 * 6_371_000 * math.asin(math.sqrt(sines))
        assert math.hypot(x, y) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[1, 2]",
        '{"gpsLatitude": 50}',
        '{"gpsLatitude": "50", "gpsLongitude": 9}',
        '{"gpsLatitude": 50, "gpsLongitude": 9, "gpsHeading": Infinity}',
        '{"gpsLatitude": 0, "gpsLongitude": 99}',
        '{"gpsLatitude": null, "gpsLongitude": 9}',
    ],
)
def test_damaged_fixes_are_refused_by_file(tmp_path, content):
    path = write(tmp_path / "a_vehicle.json", content)
    with refused(r"a_vehicle\.json must hold numbers gpsLatitude"):
        read_fix(path)
