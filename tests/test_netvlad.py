"""NetVLAD: the network against loops, the checkpoints of the PyTorch port, and the method."""

from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses
from methods import frames, noise
from plain_layers import Array, convolve, max_pool, relu, unit
from torch import nn

from ssrvlad_torch.baselines.netvlad import (
    NetVLAD,
    NetVLADLayer,
    NetVLADNetwork,
    read_netvlad,
    vgg16,
)
from ssrvlad_torch.channels.channel import View

WIDTHS = (2, 2, 2, 2, 3)
CLUSTERS, OUTPUTS = 4, 6


def test_the_layers_have_the_published_sizes():
    with torch.device("meta"):
        network = NetVLADNetwork()
    assert network.whiten.weight.shape == (4096, 32768)
    sizes = {name: p.numel() for name, p in network.named_parameters() if "encoder" not in name}
    assert sizes["pool.centroids"] == sizes["pool.conv.weight"] == 64 * 512
    assert (network.size, NetVLADNetwork(WIDTHS, 4, None).size) == (4096, 12)
    network = network.encoder
    assert sum(p.numel() for p in network.parameters()) == 14_714_688
    shapes = {n: tuple(m.weight.shape) for n, m in enumerate(network) if isinstance(m, nn.Conv2d)}
    assert [*shapes] == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    assert (shapes[0], shapes[28]) == ((64, 3, 3, 3), (512, 512, 3, 3))
    assert len(network) == 29
    assert network(torch.zeros(1, 3, 64, 70, device="meta")).shape == (1, 512, 4, 4)


@torch.no_grad()
@pytest.mark.parametrize("outputs", [5, None])
def test_netvlad_is_scaling_trunk_layer_and_whitening(outputs):
    torch.manual_seed(0)
    network = NetVLADNetwork(WIDTHS, clusters=4, outputs=outputs).double()
    image = torch.randint(0, 256, (3, 33, 47), dtype=torch.uint8)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    scaled = (image.numpy() / 255 - mean[:, None, None]) / std[:, None, None]
    vlad = network.pool(network.encoder(torch.from_numpy(scaled)[None]))[0].numpy()
    if outputs:
        matrix, bias = network.whiten.weight.numpy(), network.whiten.bias.numpy()
        vlad = unit(np.array([sum(row * vlad) for row in matrix]) + bias)
    np.testing.assert_allclose(network(image[None])[0].numpy(), vlad, rtol=1e-5)


def described(maps: Array, w: Array, b: Array, c: Array) -> Array:
    """Eq. 4: V(j, k) = sum_i softmax_k(w_k x_i + b_k) (x_i(j) - c_k(j)), then the two norms."""
    clusters, channels = w.shape
    v = np.zeros((clusters, channels))
    for x in map(unit, maps.reshape(channels, -1).T):
        odds = np.exp(w @ x + b)
        for k in range(clusters):
            for j in range(channels):
                v[k, j] += odds[k] / odds.sum() * (x[j] - c[k, j])
    return unit(np.concatenate([unit(row) for row in v]))


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_the_layer_is_equation_4(seed):
    torch.manual_seed(seed)
    layer = NetVLADLayer(clusters=4, channels=5).double()
    maps = torch.randn(2, 5, 3, 4, dtype=torch.float64)
    w, b = layer.conv.weight.flatten(1).numpy(), layer.conv.bias.numpy()
    expected = [described(m, w, b, layer.centroids.numpy()) for m in maps.numpy()]
    np.testing.assert_allclose(layer(maps).numpy(), expected, rtol=1e-9)


@torch.no_grad()
def test_the_trunk_is_thirteen_convolutions_and_four_poolings():
    torch.manual_seed(0)
    network = vgg16((2, 3, 2, 3, 2)).double()
    image = torch.rand(3, 17, 19, dtype=torch.float64)
    weights = [m for m in network if isinstance(m, nn.Conv2d)]
    maps = image.numpy()
    for number, conv in enumerate(weights):
        if number in (2, 4, 7, 10):
            maps = max_pool(maps, 2, 2)
        maps = convolve(maps, conv.weight.numpy(), conv.bias.numpy(), padding=1)
        if number < 12:
            maps = relu(maps)
    got = network(image[None])[0].numpy()
    assert got.shape == (2, 1, 1)
    np.testing.assert_allclose(got, maps, rtol=1e-9, atol=1e-12)


def write_port(path: Path, source: NetVLADNetwork, parallel: bool, bias: bool) -> None:
    """As pytorch-NetVlad's ``save_checkpoint``: epoch, state, recalls, best score, optimiser."""
    between = "module." if parallel else ""
    state = OrderedDict()
    for name, tensor in source.encoder.state_dict().items():
        state[f"encoder.{between}{name}"] = tensor
    state[f"pool.{between}centroids"] = source.pool.centroids.detach()
    state[f"pool.{between}conv.weight"] = source.pool.conv.weight.detach()
    if bias:
        state[f"pool.{between}conv.bias"] = source.pool.conv.bias.detach()
    if source.whiten is not None:
        state["WPCA.0.weight"] = source.whiten.weight.detach()[:, :, None, None]
        state["WPCA.0.bias"] = source.whiten.bias.detach()
    optimizer = torch.optim.SGD(source.parameters(), 1e-4, momentum=0.9)
    content = {
        "epoch": 30,
        "state_dict": state,
        "recalls": {n: np.float64(0.9) for n in (1, 5, 10, 20)},
        "best_score": np.float64(0.9),
        "optimizer": optimizer.state_dict(),
        "parallel": parallel,
    }
    torch.save(content, path, _use_new_zipfile_serialization=False)


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("outputs", [None, OUTPUTS])
@pytest.mark.parametrize("bias", [False, True])
def test_a_checkpoint_of_the_port_is_the_network(parallel, outputs, bias, tmp_path):
    torch.manual_seed(0)
    source = NetVLADNetwork(WIDTHS, CLUSTERS, outputs)
    if not bias:
        nn.init.zeros_(source.pool.conv.bias)
    path = tmp_path / "checkpoint.pth.tar"
    write_port(path, source, parallel, bias)
    network = read_netvlad(path, WIDTHS)
    assert network.size == source.size
    torch.testing.assert_close(network.state_dict(), source.state_dict(), rtol=0, atol=0)
    image = torch.randint(0, 256, (1, 3, 32, 32), dtype=torch.uint8)
    assert torch.equal(network(image), source(image))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A folder with the port's unzipped checkpoint, of full size, and the network in it."""
    torch.manual_seed(0)
    network = NetVLADNetwork(outputs=None).eval()
    torch.nn.init.zeros_(network.pool.conv.bias)
    folder = tmp_path_factory.mktemp("weights")
    path = folder / "vgg16_netvlad_checkpoint" / "checkpoints" / "checkpoint.pth.tar"
    path.parent.mkdir(parents=True)
    write_port(path, network, parallel=False, bias=False)
    return folder, network


def test_an_encoding_is_the_network_on_each_frame(checkpoint):
    folder, network = checkpoint
    method = NetVLAD(folder)
    assert (method.name, method.needs) == ("netvlad", {"images", "weights"})
    drive = frames([noise(0), noise(1, 40, 64), noise(0)])
    found = method.encode_query(drive)
    assert found.shape == (3, 32768)
    with torch.no_grad():
        expected = [network(torch.tensor(f.picture).permute(2, 0, 1)[None])[0] for f in drive]
    torch.testing.assert_close(found, torch.stack(expected))
    assert torch.equal(method.encode_reference(drive), found)
    scores = method.scores(found, found[:2])
    torch.testing.assert_close(scores, found @ found[:2].T)
    torch.testing.assert_close(scores[[0, 1, 2], [0, 1, 0]], torch.ones(3))
    assert method.encode_query([]).shape == (0, 32768)
    refuses("netvlad needs pictures, but frame drive/1", method.encode_query, [View("drive/1")])
    refuses("at least 16 x 16 pixels, got 15 x 40", method.encode_query, frames([noise(0, 15, 40)]))


def test_random_weights_have_the_published_size_and_say_what_they_are(monkeypatch):
    made = []

    def small(make):
        made.append(make)
        return NetVLADNetwork((2, 2, 2, 2, 2), 2, 3)

    monkeypatch.setattr("ssrvlad_torch.baselines.netvlad.random_network", small)
    method = NetVLAD(random_weights=True)
    assert method.name == "netvlad (random weights)"
    with torch.device("meta"):
        assert made[0]().size == 4096
    assert method.encode_query(frames([noise(0)])).shape == (1, 3)
