"""Region-VLAD: network, regions and VLAD against loops, the vocabulary, and the method."""

import pickle
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from helpers import refused
from methods import Array, convolve, frames, local_response_norm, max_pool, noise, relu, unit
from skimage.measure import label, regionprops

from ssrvlad_torch.baselines.region_vlad import (
    AlexNetPlaces365,
    RegionVLAD,
    read_vocabulary,
    regions_of,
)

WORDS = np.random.default_rng(0).random((4, 384))


def images(count: int = 2) -> list[np.ndarray]:
    return [noise(i, 40 + 10 * i, 60) for i in range(count)]


@torch.no_grad()
def test_the_network_is_the_layers_of_the_prototxt():
    """Loops over a part of the picture and some of the channels: what one place of conv3 sees."""
    torch.manual_seed(0)
    network = AlexNetPlaces365()
    for conv in (network.conv1, network.conv2, network.conv3):
        torch.nn.init.uniform_(conv.bias, -20, 20)
    image = torch.randint(0, 256, (3, 227, 227), dtype=torch.uint8)
    got = network(image[None])[0, :, 6, 6].double().numpy()
    weights = {n: t.double().numpy() for n, t in network.state_dict().items()}
    bgr = image.numpy()[::-1] - np.array([104.051, 112.514, 116.676])[:, None, None]
    top = 64  # pixels of conv1's window for the 3 x 3 places around (6, 6) of conv3
    window = bgr[:, top : top + 99, top : top + 99]
    maps = relu(convolve(window, weights["conv1.weight"], weights["conv1.bias"], stride=4))
    maps = local_response_norm(max_pool(maps, 3, 2), 5, 1e-4, 0.75)
    maps = relu(convolve(maps, weights["conv2.weight"], weights["conv2.bias"], groups=2))
    maps = local_response_norm(max_pool(maps, 3, 2), 5, 1e-4, 0.75)
    assert maps.shape[1:] == (3, 3)
    maps = relu(convolve(maps, weights["conv3.weight"], weights["conv3.bias"]))
    np.testing.assert_allclose(got, maps[:, 0, 0], rtol=1e-3, atol=1e-2)


def authors_way(maps: np.ndarray, count: int) -> np.ndarray:
    """Every map is labelled, boxes are sorted by mean activation, columns summed over each box."""
    result = []
    for levels in maps:
        regions = regionprops(label(levels.astype(int)), intensity_image=levels)
        result += [(region.intensity_mean, region.bbox) for region in regions]
    result.sort(key=lambda entry: -entry[0])
    boxes = [maps[:, top:low, left:right] for _, (top, left, low, right) in result[:count]]
    return np.array([box.sum(axis=(1, 2)) for box in boxes])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scale", [1.5, 4, 40])
def test_regions_are_those_of_the_authors_code(seed, scale):
    rng = np.random.default_rng(seed)
    maps = np.maximum(rng.normal(0, scale, (7, 13, 11)), 0).astype(np.float32)
    got = regions_of(torch.from_numpy(maps), 60)
    np.testing.assert_allclose(got.numpy(), authors_way(maps, 60), rtol=1e-5)


def described(descriptors: Array, words: Array) -> Array:
    """Residuals to the nearest word, summed word by word, signed root, length 1."""
    sums = np.zeros_like(words)
    for x in descriptors:
        nearest = min(range(len(words)), key=lambda k: ((x - words[k]) ** 2).sum())
        sums[nearest] += x - words[nearest]
    flat = sums.ravel()
    return unit(np.array([np.sign(v) * abs(v) ** 0.5 for v in flat]))


def write_caffe(path: Path, network: AlexNetPlaces365) -> None:
    """As Caffe stores a trained net: the wire format of protobuf, with layers that are not read."""

    def field(number: int, content: bytes) -> bytes:
        return _varint(number << 3 | 2) + _varint(len(content)) + content

    def blob(values: torch.Tensor) -> bytes:
        sizes = field(1, b"".join(map(_varint, values.shape)))
        return field(7, field(5, values.detach().numpy().tobytes()) + field(7, sizes))

    layers = [field(100, field(1, b"data") + field(2, b"Input"))]
    for name, conv in [*network.named_children()][:3]:
        layers.append(field(100, field(1, name.encode()) + blob(conv.weight) + blob(conv.bias)))
    path.write_bytes(field(1, b"AlexNet") + b"".join(layers))


def _varint(number: int) -> bytes:
    low, high = number & 127, number >> 7
    return bytes([low | 128]) + _varint(high) if high else bytes([low])


def write_vocabulary(path: Path, words: Array, protocol: int = 2) -> None:
    """As the authors' Python 2 wrote it, with a scikit-learn whose modules are gone."""
    gone = ModuleType("sklearn.cluster.k_means_")
    gone.KMeans = type("KMeans", (), {"__module__": gone.__name__})
    with pytest.MonkeyPatch.context() as patch:
        for name in ("sklearn", "sklearn.cluster"):
            patch.setitem(sys.modules, name, ModuleType(name))
        patch.setitem(sys.modules, gone.__name__, gone)
        fitted = gone.KMeans()
        fitted.cluster_centers_, fitted.random_state = words, np.random.RandomState(0)
        path.write_bytes(pickle.dumps({"400": {256: {"conv3": fitted}}}, protocol))


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(1)
    write_caffe(tmp_path / "alexnet_places365.caffemodel", AlexNetPlaces365())
    write_vocabulary(
        tmp_path / "Vocabulary_400.pkl", 300 * np.random.default_rng(0).random((256, 384))
    )
    return tmp_path


@torch.no_grad()
def test_the_descriptor_is_vlad_of_the_regions_by_the_published_files(folder):
    encoded = RegionVLAD(folder, folder).encode_query(frames(images()))
    words = 300 * np.random.default_rng(0).random((256, 384))
    torch.manual_seed(1)
    network = AlexNetPlaces365()
    for row, image in zip(encoded, images(), strict=True):
        regions = regions_of(network(torch.tensor(image).permute(2, 0, 1)[None])[0], 400)
        expected = described(regions.double().numpy(), words)
        np.testing.assert_allclose(row.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (WORDS[:3], r"expected \(4, 384\) finite numbers, got \(3, 384\)"),
        (WORDS * np.nan, r"expected \(4, 384\) finite numbers"),
        (np.array([Path("x")], object), ""),
    ],
)
def test_another_vocabulary_is_refused(words, message, tmp_path):
    write_vocabulary(tmp_path / "words.pkl", words)
    with refused(rf"words\.pkl is no vocabulary: {message}"):
        read_vocabulary(tmp_path / "words.pkl", ("400", "256", "conv3"), (4, 384))


@pytest.mark.parametrize(
    "command", [b"cos\nsystem\n(S'touch ran'\ntR.", b"cbuiltins\neval\n(S'1/0'\ntR."]
)
def test_code_in_a_pickle_does_not_run(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "words.pkl").write_bytes(command)
    with refused(r"words\.pkl is no vocabulary: (?!division)"):
        read_vocabulary(tmp_path / "words.pkl", ("400", "256", "conv3"), (4, 384))
    assert [*tmp_path.iterdir()] == [tmp_path / "words.pkl"]
