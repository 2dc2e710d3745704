"""NetVLAD: the network against loops, the checkpoints of the PyTorch port, and the method."""

from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses
from methods import Array, convolve, frames, max_pool, noise, relu, unit
from torch import nn

from ssrvlad_torch.baselines.netvlad import NetVLAD, NetVLADLayer, NetVLADNetwork, read_netvlad
from ssrvlad_torch.channels.channel import View

WIDTHS = (2, 2, 2, 2, 3)
CLUSTERS, OUTPUTS = 4, 6


@torch.no_grad()
@pytest.mark.parametrize("outputs", [5, None])
def test_netvlad_is_scaling_trunk_layer_and_whitening(outputs):
    torch.manual_seed(0)
    network = NetVLADNetwork(WIDTHS, clusters=4, outputs=outputs).double()
    image = torch.randint(0, 256, (3, 33, 47), dtype=torch.uint8)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    scaled = (image.numpy() / 255 - mean[:, None, None]) / std[:, None, None]
    expected = network.pool(network.encoder(torch.from_numpy(scaled)[None]))[0].numpy()
    if outputs:
        matrix, bias = (p.numpy() for p in network.WPCA.parameters())
        expected = unit(matrix[:, :, 0, 0] @ expected + bias)
    np.testing.assert_allclose(network(image[None])[0].numpy(), expected, rtol=1e-5)


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
    network = NetVLADNetwork((2, 3, 2, 3, 2), 1, None).encoder.double()
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
    if source.WPCA is not None:
        state |= {f"WPCA.{name}": tensor for name, tensor in source.WPCA.state_dict().items()}
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
    torch.testing.assert_close(network.state_dict(), source.state_dict(), rtol=0, atol=0)
    image = torch.randint(0, 256, (1, 3, 32, 32), dtype=torch.uint8)
    assert torch.equal(network(image), source(image))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A folder with the port's unzipped checkpoint, of full size."""
    torch.manual_seed(0)
    network = NetVLADNetwork(outputs=None).eval()
    folder = tmp_path_factory.mktemp("weights")
    path = folder / "vgg16_netvlad_checkpoint" / "checkpoints" / "checkpoint.pth.tar"
    path.parent.mkdir(parents=True)
    write_port(path, network, parallel=False, bias=True)
    return folder, network


def test_an_encoding_is_the_network_on_each_picture(checkpoint):
    folder, network = checkpoint
    sequence = frames([noise(0), noise(1, 40, 64)])
    with torch.no_grad():
        expected = [network(torch.tensor(f.picture).permute(2, 0, 1)[None])[0] for f in sequence]
    torch.testing.assert_close(NetVLAD(folder).encode_query(sequence), torch.stack(expected))


def test_small_and_missing_pictures_are_refused(checkpoint):
    method = NetVLAD(checkpoint[0])
    refuses("at least 16 x 16 pixels, got 15 x 40", method.encode_query, frames([noise(0, 15, 40)]))
    refuses("netvlad needs pictures, but frame a/1", method.encode_query, [View("a/1")])
