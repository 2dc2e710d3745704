import numpy as np
import pytest
from helpers import refused

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

NAMES = (
    "camvid-11",
    "camvid-32",
    "cityscapes-ids",
    "cityscapes-trainids",
    "mapillary-vistas-1.2",
    "synthia",
)


def ids_of(name: str, category: str) -> set[int]:
    return {label.id for label in label_space(name).classes if label.category == category}


def test_the_built_in_spaces():
    assert label_space_names() == NAMES


@pytest.mark.parametrize(
    ("name", "ids"),
    [
        ("camvid-11", range(12)),
        ("camvid-32", range(32)),
        ("cityscapes-ids", range(-1, 34)),
        ("cityscapes-trainids", [-1, *range(19), 255]),
        ("mapillary-vistas-1.2", range(66)),
        ("synthia", range(16)),
    ],
)
def test_every_published_id_is_there_once(name, ids):
    found = [label.id for label in label_space(name).classes]
    assert sorted(found) == list(ids)


def test_table_2_for_cityscapes():
    table = [{6, 7}, {8}, {11, 12, 13}, {17, 18, 19, 20}, {21, 22}, {23}, {14}, {9}]
    for category, ids in zip(CATEGORIES, table, strict=True):
        assert ids_of("cityscapes-ids", category) == ids
    assert ids_of("cityscapes-ids", DYNAMIC) == {-1, *range(24, 34)}


def test_train_ids_have_the_categories_of_their_ids():
    categories = {label.name: label.category for label in label_space("cityscapes-ids").classes}
    for label in label_space("cityscapes-trainids").classes:
        if 0 <= label.id < 19:
            assert label.category == categories[label.name]


def test_table_2_for_synthia():
    assert ids_of("synthia", "building") == {2, 5}
    assert ids_of("synthia", "pole") == {7, 9, 15}
    assert ids_of("synthia", DYNAMIC) == {8, 10, 11}
    assert not ids_of("synthia", "guard-rail") | ids_of("synthia", "parking")


def test_camvid():
    assert ids_of("camvid-11", DYNAMIC) == {8, 9, 10}
    assert ids_of("camvid-11", VOID) == {11}
    assert ids_of("camvid-11", "pole") == {2, 6}


def test_guard_rail_and_parking_of_mapillary():
    assert ids_of("mapillary-vistas-1.2", "guard-rail") == {4}
    assert ids_of("mapillary-vistas-1.2", "parking") == {10}


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("camvid-11", [11, 12]),
        ("cityscapes-trainids", [19]),
        ("cityscapes-ids", [34]),
        ("mapillary-vistas-1.2", [63, 64, 65, 66]),
    ],
)
def test_class_counts_that_scores_may_have(name, counts):
    assert list(label_space(name).channel_counts) == counts


def test_ids_in_words():
    assert label_space("cityscapes-trainids").describe_ids() == "-1 to 18, 255"


def test_pictures():
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


def test_a_custom_space(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(CUSTOM)
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
        (
            CUSTOM,
            "{name: x, source: y, classes: [{id: 0, name: a, category: void}]}",
            "every class is void",
        ),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path, old, new, message):
    file = tmp_path / "mine.yaml"
    file.write_text(CUSTOM.replace(old, new))
    with refused(message, "mine.yaml"):
        label_space(str(file))


def test_unknown_names_and_files(tmp_path):
    with pytest.raises(
        ValueError, match="unknown label space 'camvid': did you mean camvid-11 or camvid-32"
    ):
        label_space("camvid")
    with pytest.raises(ValueError, match="cannot read the label space"):
        label_space(str(tmp_path / "none.yaml"))


def test_a_file_that_changes_is_read_again_and_has_another_digest(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(CUSTOM)
    before = label_space(file)
    assert LabelSpace.from_dict(before.to_dict()) == before
    file.write_text(CUSTOM.replace("ground", "sidewalk"))
    assert label_space(file).classes[1].category == "sidewalk"
    assert label_space(file).digest != before.digest
    file.write_text(CUSTOM.replace("mine", "other"))
    assert label_space(file).digest == before.digest
