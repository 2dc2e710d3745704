"""conv3 regions of images, with the network from each form of its weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from methods import noise
from plain_layers import convolve, local_response_norm, max_pool, relu
from test_caffemodel import network as caffe_network

from ssrvlad_torch.baselines.region_features import AlexNetPlaces365, RegionFeatures
from ssrvlad_torch.baselines.regions import region_descriptors


def images(count: int = 2) -> list[np.ndarray]:
    return [noise(i, 40 + 10 * i, 60) for i in range(count)]


@pytest.fixture(scope="module")
def trained():
    torch.manual_seed(1)
    return AlexNetPlaces365().eval()


def write(path: Path, network: AlexNetPlaces365, form: str) -> None:
    state = {**network.state_dict(), "fc8.weight": torch.ones(365, 4), "fc8.bias": torch.ones(365)}
    if form == "caffe":
        names = dict.fromkeys(name.partition(".")[0] for name in state)
        layers = {n: [state[f"{n}.{kind}"].numpy() for kind in ("weight", "bias")] for n in names}
        path.write_bytes(caffe_network(layers))
    else:
        torch.save(state, path, _use_new_zipfile_serialization=form == "zip")


@pytest.mark.parametrize("form", ["caffe", "zip", "old"])
def test_regions_of_the_network_in_a_file(form, trained, tmp_path):
    path = tmp_path / "alexnet_places365.caffemodel"
    write(path, trained, form)
    found = list(RegionFeatures(tmp_path, regions=50)(images()))
    for image, regions in zip(images(), found, strict=True):
        with torch.no_grad():
            maps = trained(torch.tensor(image).permute(2, 0, 1)[None])[0]
        torch.testing.assert_close(regions, region_descriptors(maps, 50))
        assert regions.shape == (50, 384)


def test_torchvisions_alexnet_is_refused(tmp_path):
    """The PyTorch file of Places365 holds another network under the same name."""
    path = tmp_path / "alexnet_places365.pth.tar"
    torch.save({"state_dict": {"features.module.0.weight": torch.ones(64, 3, 11, 11)}}, path)
    with pytest.raises(ValueError, match=r"lacks conv1\.weight \(96, 3, 11, 11\); it has features"):
        RegionFeatures(path)


def test_random_weights_give_as_many_regions_as_a_trained_network_has():
    (found,) = RegionFeatures(random_weights=True)(images(1))
    assert found.shape == (400, 384)


def test_it_has_the_published_sizes():
    network = AlexNetPlaces365()
    counts = {n: sum(p.numel() for p in m.parameters()) for n, m in network.named_children()}
    assert counts == {"conv1": 34_944, "conv2": 307_456, "conv3": 885_120, "pool": 0, "norm": 0}
    kernels = {"conv1": (96, 3, 11, 11), "conv2": (256, 48, 5, 5), "conv3": (384, 256, 3, 3)}
    assert {n: tuple(t.shape) for n, t in network.state_dict().items()} == {
        **{f"{name}.weight": shape for name, shape in kernels.items()},
        **{f"{name}.bias": shape[:1] for name, shape in kernels.items()},
    }
    with torch.no_grad():
        maps = network(torch.randint(0, 256, (2, 3, 120, 160), dtype=torch.uint8))
    assert maps.shape == (2, 384, 13, 13)
    assert bool((maps >= 0).all())


@torch.no_grad()
def test_it_is_the_layers_of_the_prototxt():
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


@torch.no_grad()
def test_images_are_resized_as_caffe_does():
    """``caffe.io.resize_image``: bilinear, no blur before it."""
    from skimage.transform import resize

    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (300, 400, 3), np.uint8)
    small = resize(pixels / 255.0, (227, 227), order=1, anti_aliasing=False) * 255
    network = AlexNetPlaces365()
    one = network(torch.tensor(pixels).permute(2, 0, 1)[None])
    other = network(torch.tensor(small).float().permute(2, 0, 1)[None])
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-1)
