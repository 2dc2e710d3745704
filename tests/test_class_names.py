"""Names of classes -> categories: against the label spaces that are made by hand."""

import pytest

from ssrvlad_torch.segmentation.class_names import category_of_name, label_space_of_names
from ssrvlad_torch.taxonomy import label_space, label_space_names

BY_CHOICE = {"Bridge", "Tunnel", "license plate"}
"""Where a label space differs from the others, or from itself."""


@pytest.mark.parametrize("name", label_space_names())
def test_names_mean_what_the_label_spaces_say(name):
    for label in label_space(name).classes:
        if label.name not in BY_CHOICE:
            assert category_of_name(label.name) == label.category, label.name


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("building, edifice", "building"),  # ADE20K
        ("bed ", None),
        ("palm, palm tree", "vegetation"),
        ("streetlight, street lamp", "pole"),
        ("minibike, motorbike", "dynamic"),
        ("wall-brick", "building"),  # COCO-Stuff
        ("sky-other-merged", "sky"),
        ("grass-merged", "vegetation"),
        ("water-other", "void"),
        ("keyboard", None),
        ("Traffic Sign (Back)", "pole"),  # Mapillary, as on the hub
        ("Lane Marking - Crosswalk", "ground"),
        ("On Rails", "dynamic"),
        ("object--traffic-sign--direction-back", "pole"),  # Mapillary 2.0
        ("object--sign--back", "void"),
        ("marking--discrete--symbol--bicycle", "ground"),
        ("marking--discrete--arrow--other", "ground"),
        ("construction--barrier--road-median", "sidewalk"),
        ("human--person--person-group", "dynamic"),
        ("void--ground", "void"),
        ("LABEL_0", None),
    ],
)
def test_names_of_published_models_have_their_category(name, category):
    assert category_of_name(name) == category


def test_names_without_any_category_are_an_error():
    with pytest.raises(ValueError, match=r"none of the 2 class names of x \(LABEL_0, LABEL_1, "):
        label_space_of_names({0: "LABEL_0", 1: "LABEL_1"}, "x")
