import numpy as np
import pytest
import torch

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.deployment.golden import SIZE, golden_pair
from ssrvlad_torch.taxonomy import label_space_names


def pair_of(space: str, given: str = "labels", dtype: str = "uint8"):
    head = SSRVLAD.from_preset("default", labels_as=space)
    return head, golden_pair(head, given, dtype)


@pytest.mark.parametrize("space", label_space_names())
def test_every_id_of_the_space_is_in_the_input(space):
    head, pair = pair_of(space, dtype="int64")
    assert pair["labels"].shape == SIZE
    assert set(np.unique(pair["labels"])) == {label.id for label in head.label_space.classes}


@pytest.mark.parametrize(("given", "dtype"), [("labels", "uint8"), ("logits", "uint8")])
def test_the_outputs_are_the_modules(given, dtype):
    head, pair = pair_of("cityscapes-trainids", given, dtype)
    view = head.explain(torch.from_numpy(pair[given]))
    np.testing.assert_array_equal(pair["descriptor"], view.descriptor)
    np.testing.assert_array_equal(pair["keypoints"], view.keypoints.sum((2, 3)))
    assert pair["unknown"].tolist() == [0, 0]
    assert view.layers.any((2, 3)).sum() == 2 * len({0, 1, 2, 3, 4, 5})


def test_the_input_is_reduced_and_cleaned():
    """What the golden pair does not pass through it cannot show."""
    head, pair = pair_of("camvid-32")
    view = head.explain(torch.from_numpy(pair["labels"]))
    assert view.layers.shape[2:] != SIZE[1:]
    assert not torch.equal(view.layers, view.clean_layers)
    assert view.intersections.any()
