"""SSR-VLAD as a method against the head, Eq. 3 and the matching of the package."""

import numpy as np
import pytest
import torch
from drawings import SPACE, VOID
from helpers import street

from ssrvlad_torch import SSRVLAD, match
from ssrvlad_torch.baselines import make
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.recognition.temporal import temporal_sum


def frames(seeds, sequence="a"):
    return [View(f"{sequence}/{seed}", street(seed), SPACE) for seed in seeds]


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_queries_are_encoded_as_the_head_does(preset):
    head = SSRVLAD.from_preset(preset, labels_as=SPACE)
    found = make("ssr-vlad", preset=preset).encode_query(iter(frames(range(20))))
    expected = head(torch.stack([torch.from_numpy(street(seed)) for seed in range(20)]))
    assert (found.shape, found.dtype) == ((20, 480), torch.float32)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("temporal", [0, 1, 3])
def test_references_are_summed_inside_their_sequence(temporal):
    method = make("ssr-vlad", temporal=temporal)
    drives = [*frames(range(5), "a"), *frames(range(5, 9), "b")]
    single = method.encode_query(drives)
    expected = temporal_sum(single, ["a"] * 5 + ["b"] * 4, temporal)
    assert torch.equal(method.encode_reference(iter(drives)), expected)


def test_scores_are_those_of_match():
    method = make("ssr-vlad")
    empty = View("a/void", np.full((24, 32), VOID, np.uint8), SPACE)
    queries = method.encode_query([*frames(range(4)), empty])
    references = method.encode_reference([*frames(range(10, 16)), empty])
    scores = method.scores(queries, references)
    found = match(queries, references, top=7)
    ranked = scores.sort(dim=1, descending=True, stable=True)
    torch.testing.assert_close(ranked.values, found.scores)
    known = found.indices >= 0
    assert torch.equal(ranked.indices[known], found.indices[known])
    assert scores[4].isneginf().all()


def test_frames_of_several_label_spaces_are_read_each_as_its_own():
    camvid = frames([1])[0]
    cityscapes = View("a/2", np.where(street(2) > 5, 8, 0).astype(np.int32), "cityscapes-trainids")
    found = make("ssr-vlad").encode_query([camvid, cityscapes, camvid])
    for row, frame in zip(found, [camvid, cityscapes, camvid], strict=True):
        head = SSRVLAD.from_preset("default", labels_as=frame.labels_as)
        assert torch.equal(row, head(torch.from_numpy(frame.labels)[None])[0])


def test_settings_of_the_method_are_taken():
    method = make("ssr-vlad", preset="paper", rings=3)
    assert method.encode_query(frames([0])).shape == (1, 8 * 3 * 12)
    assert method.config.working_size is None


def test_the_label_space_of_a_head_stays():
    with pytest.raises(AttributeError, match="label_space"):
        SSRVLAD().label_space = None
