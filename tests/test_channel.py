"""Views: what is known of a frame, what is missing or wrong, and batches of them."""

import numpy as np
import pytest
from helpers import refuses

from ssrvlad_torch.channels.channel import View, batches, labels_of, picture_of


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (None, "^hog needs pictures, but frame a/1 has none"),
        (np.zeros((4, 5), np.uint8), r"^hog: .* frame a/1 must be .*got \(4, 5\) uint8"),
        (np.zeros((4, 5, 3)), r"got \(4, 5, 3\) float64"),
        (np.zeros((0, 5, 3), np.uint8), r"got \(0, 5, 3\) uint8"),
    ],
)
def test_a_wrong_picture_is_named(picture, message):
    refuses(message, picture_of, View("a/1", picture=picture), "hog")


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (View("a/1", labels_as="camvid-11"), "needs labels, but frame a/1 lacks a label map"),
        (View("a/1", labels=np.zeros((4, 5), int)), "frame a/1 lacks the label space"),
        (View("a/1", np.zeros((4, 5)), "camvid-11"), r"must be \(H, W\) integers, .* float64"),
        (View("a/1", np.zeros((4, 5, 1), int), "camvid-11"), r"got \(4, 5, 1\) int64"),
    ],
)
def test_a_wrong_label_map_is_named(view, message):
    refuses(message, labels_of, view, "label-grid")


def views(*sizes, labels_as="camvid-11", dtype=np.uint8):
    """Views of label maps and pictures of these widths."""
    return [
        View(f"a/{n}", np.zeros((2, width), dtype), labels_as, np.zeros((2, width, 3), np.uint8))
        for n, width in enumerate(sizes)
    ]


def test_batches_keep_the_order_and_hold_what_is_alike():
    def widths(views, size):
        return [[view.picture.shape[1] for view in batch] for batch in batches(views, size)]

    assert widths(views(*[4] * 7), 3) == [[4] * 3, [4] * 3, [4]]
    assert widths(views(1, 1, 2, 2, 2, 1), 2) == [[1, 1], [2, 2], [2], [1]]
    assert widths([], 2) == []
    unlike = [*views(4), *views(4, dtype=np.int32), *views(4, labels_as="camvid-32"), View("a/9")]
    assert [len(batch) for batch in batches(unlike, 4)] == [1] * 4
