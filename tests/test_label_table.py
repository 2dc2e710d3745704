"""From the ids of a network to ids of the head, by class names."""

import numpy as np
import pytest
from helpers import refuses
from loop_streams import CAMVID
from ssrvlad_ros import label_table

from ssrvlad_torch.taxonomy import CATEGORIES, label_space, label_space_names


def categories(labels, space):
    """``(H, W)`` indices of categories, 8 for none."""
    table = {each.id: each.category_index for each in label_space(space).classes}
    return np.vectorize(table.get)(labels)


@pytest.mark.parametrize("space", label_space_names())
def test_ids_come_to_stand_for_the_same_categories(space):
    """Of every label space of the package, shown as a network publishes it."""
    known = [each for each in label_space(space).classes if each.id >= 0]
    table = label_table.LabelTable([(each.id, each.name.upper()) for each in known])
    ids = np.array([[each.id for each in known]], np.uint8)
    got = categories(table(ids), label_table.LABELS_AS)
    np.testing.assert_array_equal(got, categories(ids, space))


def test_a_name_in_several_label_spaces_has_the_meaning_of_that_with_most_of_the_names():
    lamps = {
        place: label_table.LabelTable([(0, "lamp"), *enumerate(names, start=1)])
        for place, names in (("street", ("smallpole", "road")), ("room", ("bed", "chair")))
    }
    lamp = np.zeros((1, 1), np.uint8)
    found = {
        place: categories(table(lamp), "cityscapes-ids")[0, 0] for place, table in lamps.items()
    }
    assert found == {"street": CATEGORIES.index("pole"), "room": len(CATEGORIES)}


def test_names_of_ones_own_are_given_a_meaning():
    class_map = [(0, "asphalt"), (1, "Sky"), (2, "drone")]
    with pytest.raises(ValueError, match="3 classes, of unknown meaning: 'asphalt', 'drone'; say"):
        label_table.LabelTable(class_map)
    meanings = {"Asphalt": "ground", "drone": "dynamic", "sky": "void"}
    table = label_table.LabelTable(class_map, meanings)
    got = categories(table(np.array([[0, 1, 2]], np.uint8)), "cityscapes-ids")
    assert got.tolist() == [[CATEGORIES.index("ground"), 8, 8]]
    with pytest.raises(ValueError, match="unknown category 'street'; expected one of ground, "):
        label_table.LabelTable(class_map, {"asphalt": "street"})


def test_the_largest_id_is_unlabelled_unless_the_table_has_it():
    table = label_table.LabelTable([(1, "sky")])
    for dtype, largest in ((np.uint8, 255), (np.uint16, 65535)):
        labels = np.array([[1, largest]], dtype)
        assert categories(table(labels), "cityscapes-ids").tolist() == [[5, 8]]
    refuses(r"1 of 2 pixels .* such as 255", table, np.array([[1, 255]], np.uint16))
    everywhere = label_table.LabelTable([(255, "sky")])
    assert categories(everywhere(np.full((1, 1), 255, np.uint8)), "cityscapes-ids")[0, 0] == 5


def test_an_id_without_a_name_is_refused():
    table = label_table.LabelTable(CAMVID)
    with pytest.raises(ValueError, match=r"6 of 24 pixels .* lacks, such as 77"):
        table(np.repeat([0, 5, 77, 11], 6).reshape(4, 6).astype(np.uint8))


@pytest.mark.parametrize(
    ("class_map", "message"),
    [
        ([], "has 0 classes, of unknown meaning: all"),
        ([(1, "sky"), (1, "road")], "id 1 of 'road' stands twice"),
        ([(-1, "sky")], "id -1 of 'sky'"),
        ([(65536, "sky")], "id 65536 of 'sky'"),
    ],
)
def test_wrong_tables_are_refused(class_map, message):
    refuses(message, label_table.LabelTable, class_map)
