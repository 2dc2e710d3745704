import numpy as np
import pytest
import torch

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.deployment.golden import SIZE, golden_pair, outputs_of
from ssrvlad_torch.taxonomy import label_space_names


def pair_of(space: str, given: str = "labels", dtype: str = "uint8"):
    head = SSRVLAD.from_preset("default", labels_as=space)
    return head, golden_pair(head, given, dtype)


@pytest.mark.parametrize("space", label_space_names())
def test_every_id_of_the_space_is_in_the_input_and_one_that_is_not(space):
    head, pair = pair_of(space, dtype="int64")
    assert pair["labels"].shape[1:] == SIZE
    known = {label.id for label in head.label_space.classes}
    (unknown,) = set(np.unique(pair["labels"])) - known
    assert known < set(np.unique(pair["labels"]))
    assert unknown.astype(np.int32) in known, "32 bits do not tell them apart"
    np.testing.assert_array_equal(pair["unknown"], (pair["labels"] == unknown).sum((1, 2)))
    assert pair["unknown"][-1] > 0


def test_unknown_ids_belong_to_no_layer():
    head, pair = pair_of("camvid-11")
    labels = pair["labels"].copy()
    assert labels.max() > 11
    labels[labels > 11] = 11  # void
    np.testing.assert_array_equal(head(labels), pair["descriptor"])
    sweep = SSRVLAD(head.config, (0, 9))
    outputs = outputs_of(sweep, pair["labels"])
    np.testing.assert_array_equal(outputs["descriptor"], sweep(labels))


def test_scores_have_every_class_and_the_outputs_are_the_modules():
    head, pair = pair_of("cityscapes-trainids", "logits")
    assert set(np.unique(pair["logits"].argmax(1))) == set(range(19))
    np.testing.assert_array_equal(pair["descriptor"], head(pair["logits"]))
    assert "keypoints" not in pair
    assert pair["unknown"].tolist() == [0, 0]


def test_the_golden_input_is_changed_by_every_stage():
    """The golden pair can only check the stages that change something."""
    head, pair = pair_of("camvid-32")
    assert head.explain(pair["labels"][:1]).layers.shape[2:] != SIZE
    head = SSRVLAD.from_preset("paper", labels_as="camvid-32")
    view = head.explain(pair["labels"][:1])
    assert not torch.equal(view.layers, view.clean_layers)
    assert view.intersections.any()
    counts = golden_pair(head, "labels", "uint8")["keypoints"]
    np.testing.assert_array_equal(counts[:1], view.keypoints.sum((2, 3)))
