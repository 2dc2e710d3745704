import numpy as np
import pytest
import torch

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.deployment.golden import SIZE, golden_pair
from ssrvlad_torch.taxonomy import label_space_names


@pytest.mark.parametrize("space", label_space_names())
def test_every_id_of_the_space_is_in_the_input_and_one_that_is_not(space):
    head = SSRVLAD.from_preset("default", labels_as=space)
    pair = golden_pair(head, "labels", "int64")
    assert pair["labels"].shape[1:] == SIZE
    known = {label.id for label in head.label_space.classes}
    (unknown,) = set(np.unique(pair["labels"])) - known
    assert known < set(np.unique(pair["labels"]))
    assert unknown.astype(np.int32) in known, "32 bits do not tell them apart"
    np.testing.assert_array_equal(pair["unknown"], (pair["labels"] == unknown).sum((1, 2)))
    assert pair["unknown"][-1] > 0


def test_the_golden_input_is_changed_by_every_stage():
    """The golden pair can only check the stages that change something."""
    head = SSRVLAD.from_preset("default", labels_as="camvid-32")
    pair = golden_pair(head, "labels", "uint8")
    assert head.explain(pair["labels"][:1]).layers.shape[2:] != SIZE
    head = SSRVLAD.from_preset("paper", labels_as="camvid-32")
    view = head.explain(pair["labels"][:1])
    assert not torch.equal(view.layers, view.clean_layers)
    assert view.intersections.any()
    counts = golden_pair(head, "labels", "uint8")["keypoints"]
    np.testing.assert_array_equal(counts[:1], view.keypoints.sum((2, 3)))
