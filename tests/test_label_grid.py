"""The label grid against a loop over cells."""

import math

import numpy as np
import pytest
import torch
from drawings import ROAD, SKY, SPACE, TREE, blobs

from ssrvlad_torch.baselines import make
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.taxonomy import CATEGORIES, label_space


def frame(labels, name="a/1", space=SPACE):
    return View(name, labels=labels, labels_as=space)


def plain(labels, rows, columns):
    """Cell by cell, category by category."""
    height, width = labels.shape
    category = {label.id: label.category for label in label_space(SPACE).classes}
    numbers = []
    for name in CATEGORIES:
        for row in range(rows):
            for column in range(columns):
                top, bottom = row * height // rows, math.ceil((row + 1) * height / rows)
                left, right = column * width // columns, math.ceil((column + 1) * width / columns)
                cell = labels[top:bottom, left:right].ravel()
                fraction = sum(category[int(pixel)] == name for pixel in cell) / len(cell)
                numbers.append(math.sqrt(fraction))
    length = math.hypot(*numbers)
    return np.array(numbers) / (length or 1)


@pytest.mark.parametrize(
    ("size", "grid"),
    [((24, 40), (6, 10)), ((31, 45), (6, 10)), ((31, 45), (7, 3)), ((3, 4), (6, 10))],
)
def test_the_label_grid_equals_a_loop(size, grid):
    labels = blobs(0, *size, grain=4)
    method = make("label-grid", rows=grid[0], columns=grid[1])
    found = method.encode_query([frame(labels)])[0]
    np.testing.assert_allclose(found.numpy(), plain(labels, *grid), rtol=0, atol=1e-6)


def test_label_spaces_compare():
    in_camvid = np.array([[SKY, SKY], [ROAD, TREE]])
    in_trainids = np.array([[10, 10], [0, 8]])
    method = make("label-grid", rows=2, columns=2)
    encoded = method.encode_query(
        [frame(in_camvid), frame(in_trainids, space="cityscapes-trainids")]
    )
    assert torch.equal(encoded[0], encoded[1])
    # an unknown id is an error
    with pytest.raises(ValueError, match=r"label id 99 \(6 pixels\) is not in label space camvid"):
        method.encode_query([frame(np.full((2, 3), 99))])


@pytest.mark.parametrize("size", [(60, 100), (31, 47)])
def test_mirrored_grids_are_those_of_mirrored_label_maps(size):
    maps = [blobs(seed, *size, grain=5) for seed in range(4)]
    method = make("label-grid", columns=7)
    found = method.mirrored(method.encode_query(map(frame, maps)))
    expected = method.encode_query(frame(labels[:, ::-1].copy()) for labels in maps)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
