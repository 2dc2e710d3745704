"""conv3 regions of images, with the network from each form of its weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from test_caffemodel import network as caffe_network

from ssrvlad_torch.baselines.alexnet import AlexNetPlaces365
from ssrvlad_torch.baselines.region_features import RegionFeatures
from ssrvlad_torch.baselines.regions import region_descriptors


def images(count: int = 2) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (40 + 10 * i, 60, 3), np.uint8) for i in range(count)]


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


def test_a_wrong_shape_is_named(trained, tmp_path):
    path = tmp_path / "net.caffemodel"
    path.write_bytes(caffe_network({"conv1": [np.ones((64, 3, 11, 11)), np.ones(64)]}))
    with pytest.raises(ValueError, match=r"conv1\.weight must be \(96, 3, 11, 11\), got \(64,"):
        RegionFeatures(path)


def test_missing_weights_are_one_line(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"alexnet_places365\.caffemodel .*Places365"
    ) as error:
        RegionFeatures(tmp_path)
    assert "\n" not in str(error.value)


def test_random_weights_give_as_many_regions_as_a_trained_network_has():
    (found,) = RegionFeatures(random_weights=True)(images(1))
    assert found.shape == (400, 384)
