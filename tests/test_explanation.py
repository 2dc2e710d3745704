"""The stages of the method as figures."""

import numpy as np
import pytest
import torch
from helpers import street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.taxonomy import LabelSpace, label_space

LABELS = (
    torch.from_numpy(street(0)).where(torch.from_numpy(street(0)) != 7, 0)[None].repeat(2, 1, 1)
)


@pytest.mark.parametrize(
    ("preset", "shown"),
    [
        ("default", {"building", "upright boundaries", "falling boundaries"}),
        ("paper", {"building", "guard-rail: none", "parking: none"}),
    ],
)
def test_the_figure_of_an_explanation_has_masks_histograms_and_classes(preset, shown):
    """A label map, and each mask above its histogram; whatever is in no layer is said."""
    view = SSRVLAD.from_preset(preset, labels_as="camvid-11").explain(LABELS)
    figure = view.show(title="drive/000000")
    axes = figure.get_axes()
    titles = [axis.get_title() for axis in axes]
    assert titles[0].startswith("drive/000000\n") and shown <= {*titles}
    assert sum(axis.name == "polar" for axis in axes) == (10 if preset == "default" else 8)
    classes = [text.get_text() for text in axes[1].artists[0].get_texts()]
    assert {"sky", "building"} <= {*classes} and "fence" not in classes
    with pytest.raises(IndexError, match="expected an image from 0 to 1, got 2"):
        view.show(2)


def test_cells_that_features_see_elsewhere_too_are_darkened():
    features = np.zeros((4, 3, 2), np.uint8)
    features[2, 1] = 255
    view = SSRVLAD.from_preset("default", labels_as="camvid-11").explain(LABELS)
    picture = np.full((*LABELS.shape[1:], 3), 200, np.uint8)
    axes = view.show(picture=picture, features=features).get_axes()[0]
    shade = axes.images[1].get_array()[..., 3]
    assert shade.shape == (3, 4) and shade[1, 2] == 0 and (shade > 0.5).sum() == 11


def test_names_are_drawn_as_they_are():
    """Neither formulas nor HTML, and a name that begins with _ is not left out."""
    space = label_space("camvid-11").to_dict()
    space["name"] = '"><b>$_{$'
    names = iter(("_lane", "$\\frac{$", "a\nb"))
    for label in space["classes"]:
        label["name"] = next(names, label["name"])
    view = SSRVLAD.from_preset("default", labels_as=LabelSpace.from_dict(space)).explain(LABELS)
    figure = view.show(title="$_{$")
    figure.canvas.draw()
    axes = figure.get_axes()
    assert axes[0].get_title().startswith("\\$_{\\$\n")
    classes = {text.get_text() for text in axes[1].artists[0].get_texts()}
    assert {" _lane", "\\$\\frac{\\$", "a\\nb"} & classes and "<b>" not in view._repr_html_()
