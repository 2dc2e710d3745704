"""CoHOG against OpenCV, scikit-image and loops, and against the stored result of VPR-Bench."""

import cv2
import numpy as np
import pytest
import torch
from layout_copies import CORRIDOR, needs_corridor
from methods import frames, picture
from PIL import Image
from skimage.filters.rank import entropy
from skimage.morphology import disk

from ssrvlad_torch.baselines import cohog, make
from ssrvlad_torch.baselines.cohog import region_descriptors, region_entropies
from ssrvlad_torch.channels.channel import View


def plain_descriptors(picture):
    """Pixel by pixel as the authors' code has it, its derivatives by OpenCV."""
    rooted = np.sqrt(picture / picture.max()) * 255
    along_x = cv2.Sobel(rooted, cv2.CV_64F, 1, 0, ksize=5)
    along_y = cv2.Sobel(rooted, cv2.CV_64F, 0, 1, ksize=5)
    rows, columns = picture.shape[0] // 16, picture.shape[1] // 16
    cells = np.zeros((rows, columns, 8))
    for y, x in np.ndindex(picture.shape):
        strength = abs(along_x[y, x] + along_y[y, x]) / 2
        place = np.degrees(np.arctan2(along_y[y, x], along_x[y, x])) % 360 / 45
        lower = int(place)
        cells[y // 16, x // 16, lower % 8] += strength * (1 - (place - lower))
        cells[y // 16, x // 16, (lower + 1) % 8] += strength * (place - lower)
    regions = []
    for row in range(rows - 1):
        for column in range(columns - 1):
            region = cells[row : row + 2, column : column + 2].ravel()
            length = np.linalg.norm(region)
            regions.append(region / length if length else region)
    return np.array(regions)


def plain_score(query, chosen, reference):
    """Region by region."""
    matches = [max(float(d @ other) for other in reference) for d in query[chosen]]
    return sum(matches) / len(matches) if matches else -np.inf


@pytest.mark.parametrize("size", [(64, 64), (48, 96)])
def test_descriptors_equal_a_loop(size):
    pictures = np.stack([picture(seed, *size)[..., 0] for seed in range(3)])
    result = region_descriptors(torch.from_numpy(pictures))
    assert result.dtype == torch.float32
    for gray, regions in zip(pictures, result, strict=True):
        np.testing.assert_allclose(regions.numpy(), plain_descriptors(gray), rtol=0, atol=1e-5)


def test_entropies_of_regions_equal_those_of_the_libraries():
    gray = picture(0, 512, 512, grain=16)[..., 0]
    gray[:200, :300] = 128
    bits = cv2.resize(entropy(cv2.resize(gray, (100, 100)), disk(5)), (512, 512))
    starts = range(0, 512 - 16, 16)
    expected = [bits[y : y + 32, x : x + 32].mean() / 8 for y in starts for x in starts]
    result = region_entropies(torch.from_numpy(gray)[None])[0].numpy()
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-5)
    assert result[0] == 0
    assert result.max() > 0.4


@pytest.mark.parametrize("at_once", [1, 300, 1 << 20])
def test_scores_equal_a_loop_whatever_the_block(at_once, monkeypatch):
    for name, value in (("_SCORES_AT_ONCE", at_once), ("SIDE", 64), ("REGIONS", 9)):
        monkeypatch.setattr(cohog, name, value)
    method = make("cohog")
    queries = method.encode_query(frames([picture(0), picture(1)]))
    queries.chosen[1, ::2] = False
    references = method.encode_reference(frames(map(picture, range(5))))
    result = method.scores(queries, references)
    assert (result.shape, result.dtype) == ((2, 5), torch.float32)
    for row, column in np.ndindex(2, 5):
        query, chosen = queries.descriptors[row].numpy(), queries.chosen[row].numpy()
        expected = plain_score(query, chosen, references[column].numpy())
        assert abs(float(result[row, column]) - expected) < 1e-5


def test_only_regions_of_high_entropy_are_looked_for():
    half = picture(0, 512, 512)
    half[:, :256] = 128
    chosen = make("cohog").encode_query(frames([half])).chosen[0].view(31, 31)
    assert not chosen[:, :14].any()
    assert chosen[:, 17:].all()


def corridor(folder, step):
    files = sorted((CORRIDOR / folder).iterdir())[::step]
    return [View(f"{folder}/{file.stem}", picture=np.array(Image.open(file))) for file in files]


def corridor_scores(step, every_reference=1):
    """Ours and those that VPR-Bench stored, for every ``every``-th query and reference."""
    method = make("cohog")
    queries = method.encode_query(corridor("query", step))
    references = method.encode_reference(corridor("ref", every_reference))
    with np.load(CORRIDOR.parent / "corridor_CoHOG.npz") as stored:
        return method.scores(queries, references).numpy(), dict(stored)


@needs_corridor
def test_some_pairs_of_the_corridor_have_the_stored_scores():
    scores, stored = corridor_scores(step=25, every_reference=4)
    expected = stored["sim"][::25, ::4]
    np.testing.assert_allclose(scores, expected, rtol=0, atol=3e-3)
    assert (scores.argmax(1) == expected.argmax(1)).mean() >= 0.8
