"""`SSRVLAD.sweep`: descriptors from several anchors."""

import dataclasses

import pytest
import torch

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.descriptor import SweepHead

DEFAULT = SSRVLADConfig.from_preset("default", labels_as="cityscapes-trainids")


@pytest.fixture(scope="module")
def labels() -> torch.Tensor:
    frames = SyntheticCity(3).traverse(3)
    return torch.stack([torch.from_numpy(frame.labels) for frame in frames])


def test_the_usual_anchor_gives_the_descriptor(labels):
    head = SSRVLAD(DEFAULT)
    swept = SweepHead(DEFAULT, (-4, 0, 4))(labels)
    assert swept.shape == (3, 3, 480)
    assert torch.equal(swept[:, 1], head(labels))
    assert not torch.equal(swept[:, 0], swept[:, 1])


def test_an_anchor_is_a_column_from_the_usual_one(labels):
    head = SSRVLAD(DEFAULT)
    middle = SSRVLAD(dataclasses.replace(DEFAULT, anchor="middle"))
    columns = head.explain(labels).histograms.column
    for number, column in enumerate(columns.tolist()):
        one = labels[number : number + 1]
        assert torch.equal(middle.sweep(one, [column, column + 8]), head.sweep(one, [0, 8]))


def test_the_paper_has_no_anchor_to_move(labels):
    head = SSRVLAD.from_preset("paper", labels_as="cityscapes-trainids")
    with pytest.raises(ValueError, match="aggregation harmonics, got residuals"):
        head.sweep(labels, [0])


@pytest.mark.parametrize("columns", [[], [2**62], [0.5], ["a"]])
def test_wrong_columns_are_an_error(labels, columns):
    with pytest.raises(ValueError, match="columns: expected one or more integers"):
        SSRVLAD(DEFAULT).sweep(labels, columns)
