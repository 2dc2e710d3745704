"""Methods by name, what they share, how they are run; SSR-VLAD and the label grid."""

import math

import numpy as np
import pytest
import torch
from drawings import ROAD, SKY, SPACE, TREE, VOID, blobs
from helpers import refuses, street
from methods import frames, picture

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.baselines import make
from ssrvlad_torch.baselines.run import run
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.recognition.temporal import temporal_sum
from ssrvlad_torch.taxonomy import CATEGORIES, label_space

WITHOUT_WEIGHTS = ["ssr-vlad", "cohog", "label-grid", "hog", "tiny-image"]
BYTES = dict.fromkeys(("ssr-vlad", "label-grid", "hog"), 480 * 4)
BYTES |= {"tiny-image": 2048 * 4, "cohog": 961 * 32 * 4}


def mixed(name, count=20):
    """Frames of several sizes, and of several types of numbers."""
    if make(name).needs == {"images"}:
        return frames(picture(n, *((96, 160) if n % 5 else (60, 48))) for n in range(count))
    kinds = [((24, 40), np.uint8), ((24, 40), np.int32), ((18, 20), np.uint8)]
    drawn = [(n, *kinds[n % 7 % 3]) for n in range(2 * count)]
    return [View(f"a/{n}", blobs(n, *size, grain=5).astype(t), SPACE) for n, size, t in drawn]


def parts(encodings):
    fields = getattr(encodings, "_asdict", lambda: vars(encodings))
    return [encodings] if isinstance(encodings, torch.Tensor) else [*fields().values()]


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_no_frames_are_refused(name):
    refuses(f"method {name}: no frames to encode", make(name).encode_reference, [])


@pytest.mark.parametrize("name", WITHOUT_WEIGHTS)
def test_a_batch_equals_one_by_one_whatever_the_kinds(name):
    method, drive = make(name), mixed(name)
    together, references = method.encode_query(iter(drive)), method.encode_reference(drive)
    single = [parts(method.encode_query([frame])) for frame in drive]
    for result, *alone in zip(parts(together), *single, strict=True):
        assert torch.equal(result, torch.cat(alone))
    torch.testing.assert_close(parts(references)[0], parts(together)[0])
    assert references.nbytes == len(drive) * BYTES[name]


@pytest.mark.parametrize("name", ["ssr-vlad", "cohog", "label-grid", "hog"])
def test_a_frame_of_nothing_matches_nothing(name):
    method = make(name)
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
    refuses(f"{name} needs {what}, but frame b/7 ", method.encode_reference, [View("b/7")])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("orb", {}, "unknown method 'orb'; expected one of ssr-vlad, feat"),
        ("cohog", {"cell": 3}, "method cohog: got an unexpected keyword argument 'cell'"),
        ("ssr-vlad", {"cell": 3}, "unknown setting 'cell'"),
        ("ssr-vlad", {"temporal": -1}, "temporal must be 0 or more, got -1"),
        ("ssr-vlad", {"preset": "best"}, "preset must be one of paper, default, got 'best'"),
    ],
)
def test_unknown_methods_and_wrong_settings_are_refused(name, settings, message):
    refuses(message, make, name, **settings)


class Numbers:
    """A method whose frames are numbers; those that are near score high, negative ones nothing."""

    name = "numbers"
    needs = frozenset({"labels"})

    def __init__(self):
        self.blocks = []

    def encode_query(self, frames):
        numbers = torch.tensor([float(frame.frame.rpartition("/")[2]) for frame in frames])
        self.blocks.append(len(numbers))
        return numbers

    encode_reference = encode_query

    def scores(self, queries, references):
        scores = -(queries[:, None] - references).abs()
        return scores.masked_fill((queries < 0)[:, None] | (references < 0), -torch.inf)


def numbered(sequence, *numbers):
    return (View(f"{sequence}/{number}") for number in numbers)


def test_candidates_are_ranked_and_ties_keep_the_order():
    queries, references = numbered("q", 2, 7, -1, 30), numbered("r", 0, 4, -1, 8, 6)
    result = run(Numbers(), queries, references, top=3)
    scores, indices = result.matches
    assert indices.tolist() == [[0, 1, 4], [3, 4, 1], [-1, -1, -1], [3, 4, 1]]
    inf = torch.inf
    assert scores.tolist() == [[-2, -2, -4], [-1, -1, -3], [-inf] * 3, [-22, -24, -26]]
    assert (scores.dtype, indices.dtype) == (torch.float32, torch.int64)
    assert result.costs["bytes_a_reference"] == 4


def streets(seeds, sequence="a"):
    return [View(f"{sequence}/{seed}", street(seed), SPACE) for seed in seeds]


@pytest.mark.parametrize("temporal", [0, 1, 3])
def test_references_are_summed_inside_their_sequence(temporal):
    method = make("ssr-vlad", temporal=temporal)
    drives = [*streets(range(5), "a"), *streets(range(5, 9), "b")]
    single = method.encode_query(drives)
    expected = temporal_sum(single, ["a"] * 5 + ["b"] * 4, temporal)
    assert torch.equal(method.encode_reference(iter(drives)), expected)


def test_frames_of_several_label_spaces_are_read_each_as_its_own():
    camvid = streets([1])[0]
    cityscapes = View("a/2", np.where(street(2) > 5, 8, 0).astype(np.int32), "cityscapes-trainids")
    result = make("ssr-vlad").encode_query([camvid, cityscapes, camvid])
    for row, frame in zip(result, [camvid, cityscapes, camvid], strict=True):
        head = SSRVLAD.from_preset("default", labels_as=frame.labels_as)
        assert torch.equal(row, head(torch.from_numpy(frame.labels)[None])[0])


def plain_grid(labels, rows=6, columns=10):
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


@pytest.mark.parametrize("size", [(24, 40), (31, 45), (3, 4)])
def test_the_label_grid_equals_a_loop(size):
    labels = blobs(0, *size, grain=4)
    result = make("label-grid").encode_query([View("a/1", labels, SPACE)])[0]
    np.testing.assert_allclose(result.numpy(), plain_grid(labels), rtol=0, atol=1e-6)


def test_label_spaces_compare():
    in_camvid = np.array([[SKY, SKY], [ROAD, TREE]])
    in_trainids = np.array([[10, 10], [0, 8]])
    method = make("label-grid")
    spaces = (in_camvid, SPACE), (in_trainids, "cityscapes-trainids")
    encoded = method.encode_query(View("a/1", *labels) for labels in spaces)
    assert torch.equal(encoded[0], encoded[1])
    # an unknown id is an error
    with pytest.raises(ValueError, match=r"label id 99 \(6 pixels\) is not in label space camvid"):
        method.encode_query([View("a/1", np.full((2, 3), 99), SPACE)])
