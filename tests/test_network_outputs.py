"""What a network gives: class scores and labels of any form."""

import types

import numpy as np
import pytest
import torch
from drawings import SPACE
from helpers import refuses, street
from networks import NOISE, PHOTOS, PLAIN, Strided, Then, assert_right, photo, write_photos

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.segmentation.preparation import Preparation, SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter

OUTPUTS = {
    "tensor": lambda scores: scores,
    "torchvision": lambda scores: {"out": scores, "aux": -scores},
    "one of a mapping": lambda scores: {"features": scores[:, :5], "segmentation": scores},
    "transformers": lambda scores: types.SimpleNamespace(loss=None, logits=scores),
    "tuple": lambda scores: (scores, scores.mean((2, 3))),
    "half": lambda scores: scores.half(),
    "channels last": lambda scores: scores.permute(0, 2, 3, 1),
    "ids": lambda scores: scores.argmax(1),
    "ids with an axis": lambda scores: scores.argmax(1, keepdim=True),
    "ids with an axis at the end": lambda scores: scores.argmax(1)[..., None],
    "ids in 16 bits": lambda scores: scores.argmax(1).to(torch.uint16),
    "ids without a batch": lambda scores: scores.argmax(1).squeeze(),
    "quantised": lambda scores: torch.zeros_like(scores, dtype=torch.int8).scatter(
        1, scores.argmax(1, keepdim=True), 127
    ),
}


@pytest.mark.parametrize("form", OUTPUTS)
def test_an_output_is_recognised_by_its_shape(form):
    assert_right(Segmenter(Then(OUTPUTS[form]), SPACE, PLAIN))


@pytest.mark.parametrize(
    ("form", "size"),
    [
        *((form, size) for form in ("tensor", "channels last") for size in ((12, 16), (16, 12))),
        ("tensor", (12, 12)),
    ],
)
@pytest.mark.parametrize("classes", [None, (0, 12)])
def test_the_axis_of_the_classes_does_not_follow_the_size_of_a_picture(form, size, classes):
    segmenter = Segmenter(Then(OUTPUTS[form]), SPACE, PLAIN, classes=classes)
    for height, width in (size, (24, 32), (17, 12)):
        labels = street(3, height, width)
        assert_right(segmenter, [photo(labels)], [labels])


@pytest.mark.parametrize(
    ("give", "message"),
    [
        (
            lambda scores: scores[:, :7],
            r"no output fits label space camvid-11: got output \(1, 7, 24, 32\) float32; "
            r"expected \(B, C, h, w\) class scores, C = 11 or 12, or \(B, h, w\) integer ids$",
        ),
        (
            lambda scores: torch.cat([scores, scores], 1),
            r"; classes: 0:12 in a YAML file takes the first 12",
        ),
        (
            lambda scores: torch.cat([scores, scores[:, :7]], 1),
            "; so many has cityscapes-trainids; classes: 0:12 in a YAML file takes the first 12$",
        ),
        (lambda scores: scores[:, 0] > 0, r"got output \(1, 24, 32\) bool"),
        (lambda scores: scores.long(), r"got output \(1, 12, 24, 32\) int64"),
        (lambda scores: {"a": scores, "b": scores}, r"several .*: a \(1, 12.*, b \(1, 12"),
        (lambda scores: scores.repeat(2, 1, 1, 1), "gives 2 outputs for 1 images"),
        (lambda scores: None, "gives a NoneType without tensors"),
    ],
)
def test_an_output_that_cannot_be_recognised_is_an_error_that_has_it(give, message):
    refuses(message, Segmenter(Then(give), SPACE, PLAIN), PHOTOS[:1])


def test_the_output_and_the_channels_may_be_named():
    def give(scores):
        return {"one": torch.cat([scores[:, :3] + 9, scores], 1), "other": -scores}

    assert_right(Segmenter(Then(give), SPACE, PLAIN, output="one", classes=(3, 15)))
    with pytest.raises(ValueError, match=r"no output 'out'; the outputs are one \(1, 15, 24"):
        Segmenter(Then(give), SPACE, SegmenterConfig(output="out"))(PHOTOS[:1])


@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("size", [None, (16, 40), 40])
def test_the_class_is_decided_at_the_stride_of_the_scores(stride, size):
    network = Strided(stride)
    config = SegmenterConfig(size=size)
    (labels,) = Segmenter(network, SPACE, config)([NOISE])
    scores = network(Preparation(config)(torch.from_numpy(NOISE)[None]))[0]
    best = scores.detach().numpy().argmax(0)
    rows, columns = (
        [int((i + 0.5) * cells / pixels) for i in range(pixels)]
        for cells, pixels in zip(best.shape, (17, 23), strict=True)
    )
    np.testing.assert_array_equal(labels, best[np.ix_(rows, columns)])


def test_nan_scores_are_skipped_for_the_image_that_has_them(tmp_path):
    def spoil(scores):
        scores[1, 4, 2:4, 7] = torch.nan
        return scores

    files = find_image_files([str(write_photos(tmp_path / "a"))])
    results = [labels for _, labels in Segmenter(Then(spoil), SPACE, PLAIN).label_maps(files)]
    assert [isinstance(result, ValueError) for result in results] == [False, True, *[False] * 3]
    assert "hold 2 NaN values" in str(results[1])
