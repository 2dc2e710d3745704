import numpy as np
import pytest
from helpers import refused, refuses

from ssrvlad_torch.taxonomy import (
    CATEGORIES,
    DYNAMIC,
    VOID,
    LabelSpace,
    colourise,
    label_space,
    label_space_names,
    palette,
)

IDS = {
    "ade20k": [*range(150), 255],
    "ade20k-annotations": range(151),
    "camvid-11": range(12),
    "camvid-32": range(32),
    "carla-0.9.13": range(23),
    "carla-0.9.14": range(29),
    "cityscapes-ids": range(-1, 34),
    "cityscapes-trainids": [-1, *range(19), 255],
    "kitti-360": range(-1, 45),
    "mapillary-vistas-1.2": range(66),
    "mapillary-vistas-2.0": range(124),
    "synthia": range(16),
}


def test_every_published_id_is_there_once():
    assert label_space_names() == tuple(IDS)
    for name, ids in IDS.items():
        assert sorted(label.id for label in label_space(name).classes) == [*ids]


TABLE_2 = [{6, 7}, {8}, {11, 12, 13}, {17, 18, 19, 20}, {21, 22}, {23}, {14}, {9}]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "cityscapes-ids",
            {**dict(zip(CATEGORIES, TABLE_2, strict=True)), DYNAMIC: {-1, *range(24, 34)}},
        ),
        (
            "synthia",
            {
                **{"building": {2, 5}, "pole": {7, 9, 15}, "guard-rail": set(), "parking": set()},
                DYNAMIC: {8, 10, 11},
            },
        ),
        ("camvid-11", {DYNAMIC: {8, 9, 10}, VOID: {11}, "pole": {2, 6}}),
        ("mapillary-vistas-1.2", {"guard-rail": {4}, "parking": {10}}),
        ("mapillary-vistas-2.0", {"guard-rail": {6}, "parking": {17, 18}, "sky": {61}}),
        ("kitti-360", {"pole": {17, 18, 19, 20, 37, 38}, "building": {11, 12, 13, 34, 35}}),
        ("carla-0.9.13", {"ground": {6, 7, 14}, "guard-rail": {17}, "sky": {13}}),
        ("carla-0.9.14", {"ground": {1, 24, 25}, "guard-rail": {28}, "sky": {11}}),
        ("ade20k", {"sky": {2}, "pole": {43, 87, 93, 136}, "sidewalk": {11, 52}}),
        ("ade20k-annotations", {"sky": {3}, "pole": {44, 88, 94, 137}, "sidewalk": {12, 53}}),
    ],
)
def test_categories_have_the_ids_of_table_ii(name, expected):
    """Those of Cityscapes and SYNTHIA are in Table II."""
    for category, ids in expected.items():
        assert {
            label.id for label in label_space(name).classes if label.category == category
        } == ids


def test_colourise_uses_the_palette_and_magenta_for_unknown_ids():
    assert palette("camvid-11").shape == (256, 3)
    assert palette("camvid-11")[3].tolist() == [128, 64, 128]
    picture = colourise(np.array([[3, 99]]), "camvid-11")
    assert picture.tolist() == [[[128, 64, 128], [255, 0, 255]]]


CUSTOM = """
name: mine
source: my own robot
classes:
  - {id: 0, name: nothing, category: void}
  - {id: 5, name: path, category: ground, colour: [1, 2, 3]}
  - {id: 300, name: dog, category: dynamic}
"""


UNKNOWN = "{id: 0, name: nothing, category: void}"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(CUSTOM)
    return path


def test_a_custom_label_space_is_read_from_yaml(file):
    space = label_space(str(file))
    assert space.name == "mine"
    assert [label.category_index for label in space.classes] == [8, 0, 8]
    assert list(space.channel_counts) == []
    assert palette(str(file))[5].tolist() == [1, 2, 3]
    assert [label.colour for label in space.classes] == [None, (1, 2, 3), None]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("category: ground", "category: lava", "id 5 has category 'lava'; expected one of ground"),
        ("id: 300", "id: 5", "id 5 is defined more than once"),
        ("id: 300", "id: x", "id 'x' must be an integer"),
        ("[1, 2, 3]", "[1, 2, 999]", "id 5 has colour"),
        ("[1, 2, 3]", "7", "id 5 has colour 7"),
        ("name: dog, ", "", "must have id, name and category"),
        ("source: my own robot", "", "is not a label space: expected a mapping with name, source"),
        ("classes:", "classes: [", "is not plain YAML"),
        (CUSTOM, "- 3", "is not a label space"),
        (CUSTOM, "{name: x, source: y, classes: []}", "at least one class"),
        (CUSTOM, "{name: x, source: y, classes: [" + UNKNOWN + "]}", "every class is void"),
    ],
)
def test_a_wrong_file_is_refused_with_the_reason(file, old, new, message):
    file.write_text(CUSTOM.replace(old, new))
    with refused(message, "mine.yaml"):
        label_space(str(file))


def test_an_unknown_name_gets_suggestions_and_a_missing_file_is_named(tmp_path):
    hint = "unknown label space 'camvid': did you mean camvid-11 or camvid-32"
    refuses(hint, label_space, "camvid")
    refuses("cannot read the label space", label_space, str(tmp_path / "none.yaml"))


def test_a_file_that_changes_is_read_again_and_has_another_digest(file):
    before = label_space(file)
    assert LabelSpace.from_dict(before.to_dict()) == before
    file.write_text(CUSTOM.replace("ground", "sidewalk"))
    assert label_space(file).classes[1].category == "sidewalk"
    assert label_space(file).digest != before.digest
    file.write_text(CUSTOM.replace("mine", "other"))
    assert label_space(file).digest == before.digest
