"""Methods by name, what they share, how they are run; SSR-VLAD and the label grid."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from drawings import SPACE, VOID, blobs
from helpers import refuses, street
from methods import frames, noise, picture
from networks import PLAIN, Street, write_photos, write_street
from PIL import Image
from skimage.feature import hog as skimage_hog

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.baselines import channel_methods, make
from ssrvlad_torch.baselines.channel_methods import EncoderFeatures
from ssrvlad_torch.baselines.comparison import encoded_bytes, run
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.channels.hog import CELL, ORIENTATIONS, grays, resize
from ssrvlad_torch.recognition.recognise import references_of
from ssrvlad_torch.recognition.temporal import temporal_sum
from ssrvlad_torch.segmentation.segmenter import Segmenter
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
def test_a_batch_equals_one_by_one_whatever_the_kinds(name):
    method, drive = make(name), mixed(name)
    together, references = method.encode_query(iter(drive)), method.encode_reference(drive)
    single = [parts(method.encode_query([frame])) for frame in drive]
    for result, *alone in zip(parts(together), *single, strict=True):
        assert torch.equal(result, torch.cat(alone))
    torch.testing.assert_close(parts(references)[0], parts(together)[0])
    assert encoded_bytes(references) == len(drive) * BYTES[name]


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


# ---- hOG against scikit-image, cell histograms against a loop


@pytest.mark.parametrize("seed", range(3))
def test_hog_is_that_of_scikit_image(seed):
    """On images of the working size; the epsilon of its norms is of no weight here."""
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (96, 160), dtype=np.uint8)
    blocks = skimage_hog(
        picture.astype(float),
        orientations=ORIENTATIONS,
        pixels_per_cell=(CELL, CELL),
        cells_per_block=(1, 1),
        block_norm="L2",
    )
    descriptor = make("hog").encode_query(frames([np.repeat(picture[..., None], 3, axis=2)]))[0]
    np.testing.assert_allclose(
        descriptor.numpy(), blocks / np.linalg.norm(blocks), rtol=0, atol=1e-5
    )


# ---- gray pictures against Pillow, and their resizing against OpenCV, bit for bit


def test_gray_is_that_of_pillow_and_frames_of_one_size_become_one_tensor():
    drive = frames(noise(seed, 30, 40) for seed in range(3))
    together = grays(drive, "hog")
    assert together.dtype == torch.uint8
    expected = [np.asarray(Image.fromarray(frame.picture).convert("L")) for frame in drive]
    np.testing.assert_array_equal(together.numpy(), expected)


@pytest.mark.parametrize("after", [(512, 512), (100, 100), (96, 160), (1, 1)])
@pytest.mark.parametrize(
    "before",
    [(120, 160), (360, 480), (512, 512), (1024, 1000), (77, 80), (999, 13), (2, 3), (1, 5), (1, 1)],
)
def test_resize_is_that_of_opencv(before, after):
    pictures = np.stack([noise(1, *before)[..., 0], np.full(before, 255, np.uint8)])
    result = resize(torch.from_numpy(pictures), *after)
    assert (result.shape, result.dtype) == ((2, *after), torch.uint8)
    for gray, resized in zip(pictures, result, strict=True):
        expected = cv2.resize(gray, after[::-1], interpolation=cv2.INTER_LINEAR)
        np.testing.assert_array_equal(resized.numpy(), expected.reshape(after))


# ---- tiny images against loops over patches and sequences


def image(seed):
    return picture(seed, 64, 128, grain=8)


def plain_picture(gray, height, width):
    """Area means, then patch by patch; the sides of ``gray`` are multiples of the small ones."""
    tall, wide = gray.shape[0] // height, gray.shape[1] // width
    tiny = gray.reshape(height, tall, width, wide).astype(float).mean((1, 3))
    for y in range(0, height, 8):
        for x in range(0, width, 8):
            patch = tiny[y : y + 8, x : x + 8]
            deviation = patch.std()
            patch -= patch.mean()
            patch /= deviation or 1
    return tiny


def plain_scores(difference, sequences):
    """Reference by reference."""
    scores = np.zeros_like(difference)
    for q, i in np.ndindex(difference.shape):
        around = [
            difference[q, j] for j in range(difference.shape[1]) if sequences[j] == sequences[i]
        ]
        deviation = np.std(around)
        z = (np.mean(around) - difference[q, i]) / deviation if deviation > 1e-9 else 0
        scores[q, i] = 1 - np.exp(-z)
    return scores


def test_scores_equal_loops_whatever_the_block(monkeypatch):
    monkeypatch.setattr(channel_methods, "_SCORES_AT_ONCE", 18)
    method = make("tiny-image")
    drives = [*frames(map(image, range(6)), "a"), *frames(map(image, range(6, 9)), "b")]
    queries = [image(seed) for seed in (1, 4, 8, 20, 21)]
    result = method.scores(method.encode_query(frames(queries)), method.encode_reference(drives))
    assert (result.shape, result.dtype) == ((5, 9), torch.float32)
    alone = method.encode_reference([*frames([image(0)], "a"), *frames([image(1)] * 50, "b")])
    assert not method.scores(method.encode_query(frames(queries)), alone).any(), "all are alike"
    there = np.stack([plain_picture(frame.picture[..., 0], 32, 64) for frame in drives])
    here = np.stack([plain_picture(query[..., 0], 32, 64) for query in queries])
    difference = np.abs(here[:, None] - there).mean((2, 3))
    expected = plain_scores(difference, [frame.sequence for frame in drives])
    np.testing.assert_allclose(result.numpy(), expected, rtol=0, atol=1e-3)
    assert result[:3].argmax(1).tolist() == [1, 4, 8]
    gray = noise(0, 64, 192)[..., :1].repeat(3, 2)
    encoded = method.encode_query(frames([gray])).view(32, 64).numpy()
    expected = plain_picture(gray[..., 0], 32, 64)
    np.testing.assert_allclose(encoded, expected, rtol=0, atol=1e-5)


# ---- features as a method: the signs of `Segmenter.segment`, and their steps


@pytest.fixture
def segmenter():
    return Segmenter(Street(), SPACE, PLAIN)


def drive(count: int, sequence: str = "a") -> list[View]:
    """Pictures of one size, each of other blocks."""
    return frames((picture(n, 128, 192, grain=16) for n in range(count)), sequence)


def test_scores_are_the_cosines_of_the_signs_of_the_segmenter(segmenter):
    method, pictures = EncoderFeatures(segmenter), [frame.picture for frame in drive(6)]
    signs = method.encode_reference(drive(6))
    expected = [result.features for result in segmenter.segment(pictures, features=True)]
    np.testing.assert_array_equal(signs.numpy(), np.stack(expected))
    assert torch.equal(method.encode_query(drive(6)), signs)
    scores = method.scores(signs[:2], signs)
    town = references_of({"features": signs}, [""] * len(signs))
    expected, _ = town.compare({"features": signs[:2].numpy()}, sweep=True)
    np.testing.assert_allclose(scores, expected)
    assert scores.argmax(1).tolist() == [0, 1]


def test_compare_measures_it(ssrvlad, tmp_path):
    write_street(tmp_path / "net.onnx")
    network = tmp_path / "net.yaml"
    network.write_text("network: net.onnx\nlabels_as: camvid-11\n")
    for drive in ("query", "reference"):
        write_photos(tmp_path / "town" / drive / "images", size=(48, 64))
    options = ("--set", f"features.network={network}", "--tolerance-frames", 0, "--json")
    code, out, err = ssrvlad("compare", tmp_path / "town", "--method", "features,hog", *options)
    assert code == 0, err
    row = json.loads(out)["rows"][0]
    assert (row["method"], row["recall_at"]["1"]) == ("features", 1.0)
    with pytest.raises(FileNotFoundError, match="no network: features needs a segmentation net"):
        make("features")
