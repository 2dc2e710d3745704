"""The sequence filter: a map that grows. Against a plain model it is tested through `follow`."""

import torch
from test_follow import noisy

from ssrvlad_torch.recognition.filter import Filter


def test_a_map_that_grows_is_the_map_that_was_whole():
    whole, grown = Filter(["a"] * 7 + ["b"] * 5), Filter(["a"] * 4)
    grown.extend(["a"] * 3)
    grown.extend(["b"] * 5)
    grown.restart()
    for scores in noisy([3, 4, 5, 6], 12):
        whole.step(scores)
        grown.step(scores)
    assert torch.equal(whole.rows(), grown.rows())
