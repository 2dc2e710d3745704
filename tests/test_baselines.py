"""What all methods share: batches, empty frames, refusals."""

import numpy as np
import pytest
import torch
from drawings import SPACE, VOID, blobs
from methods import frames, picture

from ssrvlad_torch.baselines import make
from ssrvlad_torch.channels.channel import View

WITHOUT_WEIGHTS = ["ssr-vlad", "cohog", "label-grid", "hog", "tiny-image"]
BYTES = dict.fromkeys(("ssr-vlad", "label-grid", "hog"), 480 * 4)
BYTES |= {"tiny-image": 2048 * 4, "cohog": 49 * 32 * 4}


def small(name):
    """A method on pictures of at most 128 x 128 pixels."""
    return make(name, **({"size": 128} if name == "cohog" else {}))


def mixed(name, count=20):
    """Frames of several sizes, and of several types of numbers."""
    if small(name).needs == {"images"}:
        return frames(picture(n, *((96, 160) if n % 5 else (60, 48))) for n in range(count))
    kinds = [((24, 40), np.uint8), ((24, 40), np.int32), ((18, 20), np.uint8)]
    drawn = [(n, *kinds[n % 7 % 3]) for n in range(2 * count)]
    return [View(f"a/{n}", blobs(n, *size, grain=5).astype(t), SPACE) for n, size, t in drawn]


def parts(encodings):
    return [encodings] if isinstance(encodings, torch.Tensor) else [*vars(encodings).values()]


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_no_frames_make_empty_encodings(name):
    method = make(name)
    queries, references = method.encode_query([]), method.encode_reference([])
    assert (len(queries), len(references)) == (0, 0)
    scores = method.scores(queries, references)
    assert (scores.shape, scores.dtype) == ((0, 0), torch.float32)


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_a_batch_equals_one_by_one_whatever_the_kinds(name):
    method, drive = small(name), mixed(name)
    together, references = method.encode_query(iter(drive)), method.encode_reference(drive)
    single = [parts(method.encode_query([frame])) for frame in drive]
    for found, *alone in zip(parts(together), *single, strict=True):
        assert torch.equal(found, torch.cat(alone))
    torch.testing.assert_close(parts(references)[0], parts(together)[0])
    assert (len(together), parts(together)[0].dtype) == (len(drive), torch.float32)
    assert references[2:5].nbytes == 3 * BYTES[name] == 3 * references.nbytes // len(drive)
    chosen = 49 if name == "cohog" else 0
    assert together[2:5].nbytes == 3 * (BYTES[name] + chosen)
    for part, whole in zip(parts(together[2:5]), parts(together), strict=True):
        assert torch.equal(part, whole[2:5])


@pytest.mark.parametrize("name", ["ssr-vlad", "cohog", "label-grid", "hog"])
def test_a_frame_of_nothing_matches_nothing(name):
    method = small(name)
    drive = frames([np.full((50, 60, 3), 9, np.uint8), np.zeros((50, 60, 3), np.uint8)])
    if method.needs == {"labels"}:
        drive = [View(f"a/{void}", np.full((12, 20), void), SPACE) for void in (VOID, VOID)]
    references = method.encode_reference([*drive, mixed(name)[0]])
    assert not references[:2].any() and references[2].any()
    assert method.scores(method.encode_query(drive), references).isneginf().all()
    scores = method.scores(method.encode_query([mixed(name)[0]]), references)[0]
    none = 0 if name == "cohog" else -torch.inf
    torch.testing.assert_close(scores, torch.tensor([none, none, 1.0]), rtol=1e-3, atol=0)


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_a_frame_without_what_a_method_reads_is_named(name):
    method = make(name)
    (need,) = method.needs
    what = "pictures" if need == "images" else need
    with pytest.raises(ValueError, match=f"{name} needs {what}, but frame b/7 "):
        method.encode_reference([View("b/7")])


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_methods_without_weights_are_made_by_name(name):
    method = make(name)
    assert method.name == name
    assert method.needs in ({"labels"}, {"images"})
