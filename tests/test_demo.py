"""The picture of queries and matches."""

import numpy as np
import pytest

from ssrvlad_torch.cli.demo import Pair, chosen, draw_pairs
from ssrvlad_torch.taxonomy import label_space


@pytest.mark.parametrize(
    ("right", "matched", "expected"),
    [
        ([True] * 9, [True] * 9, [0, 4, 8]),
        ([True] * 5 + [False] + [True] * 3, [True] * 9, [0, 4, 5]),
        ([False] + [True] * 8, [True] * 9, [0, 4, 8]),
        ([True, True], [True, True], [0, 1]),
        ([True, False, True], [True, False, True], [0, 2]),
    ],
)
def test_a_wrong_match_is_among_them_if_there_is_one(right, matched, expected):
    assert chosen(right, matched, 3) == expected


def test_right_is_green_and_wrong_is_red():
    sky, road = np.full((48, 64), 10), np.full((48, 64), 0)
    space = label_space("cityscapes-trainids")
    names = ("query/000000", "reference/000000, score 0.50")
    sheets = [
        np.asarray(draw_pairs([Pair(sky, road, *names, right)] * 2, space))
        for right in (True, False)
    ]
    for sheet, verdict in zip(sheets, ((26, 127, 55), (207, 34, 46)), strict=True):
        found = {tuple(pixel) for pixel in np.unique(sheet.reshape(-1, 3), axis=0).tolist()}
        assert {verdict, (70, 130, 180), (128, 64, 128)} <= found
        assert (0, 0, 142) not in found
