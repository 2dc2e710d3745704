"""The published forms of NetVLAD's weights, each written here as its authors write it."""

from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from plain_layers import Array, unit
from scipy.io import savemat
from test_matconvnet import layer, network
from torch import Tensor, nn

from ssrvlad_torch.baselines.netvlad_network import NetVLADNetwork
from ssrvlad_torch.baselines.netvlad_weights import read_netvlad_weights
from ssrvlad_torch.baselines.weights import fill

WIDTHS = (2, 2, 3, 3, 5)
CLUSTERS, OUTPUTS = 4, 6
NAMES = [f"{block}_{n}" for block in range(1, 6) for n in range(1, 3 + (block > 2))]


def trained(outputs: int | None = OUTPUTS) -> NetVLADNetwork:
    torch.manual_seed(0)
    return NetVLADNetwork(WIDTHS, CLUSTERS, outputs)


def loaded(path: Path, outputs: int | None) -> NetVLADNetwork:
    network = NetVLADNetwork(WIDTHS, CLUSTERS, outputs)
    fill(network, read_netvlad_weights(path), path)
    return network


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


def write_mat(path: Path, source: NetVLADNetwork, **changes: object) -> None:
    """As ``net_class2struct.m`` saves what ``addLayers.m`` and ``addPCA.m`` made."""
    convs = [m for m in source.encoder if isinstance(m, nn.Conv2d)]
    layers = [
        layer(f"conv{name}", array(conv.weight).transpose(2, 3, 1, 0), array(conv.bias)[:, None])
        for name, conv in zip(NAMES, convs, strict=True)
    ]
    assign, centres = (
        array(t.flatten(1)).T for t in (source.pool.conv.weight, source.pool.centroids)
    )
    layers += [
        {"type": "normalize", "name": "preL2", "param": np.array([10, 1e-12, 1, 0.5])},
        layer("vlad:core", assign[None, None], -centres[None, None]),
        {"type": "custom", "name": "postL2"},
    ]
    if source.whiten is not None:
        by_centre = array(source.whiten.weight).reshape(OUTPUTS, CLUSTERS, WIDTHS[-1])
        matrix = by_centre.transpose(2, 1, 0).reshape(1, 1, -1, OUTPUTS)
        layers.append(layer("WPCA", matrix, array(source.whiten.bias)[:, None]))
    content = network(*(changes.get(str(one["name"]), one) for one in layers))
    content["meta"]["normalization"]["averageImage"] = array(source.mean)[None, None]
    savemat(path, {"net": content})


def array(tensor: Tensor) -> Array:
    return tensor.detach().numpy()


def same(one: nn.Module, other: nn.Module) -> bool:
    theirs = other.state_dict()
    return all(torch.equal(tensor, theirs[name]) for name, tensor in one.state_dict().items())


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("outputs", [None, OUTPUTS])
@pytest.mark.parametrize("bias", [False, True])
def test_the_port(parallel, outputs, bias, tmp_path):
    source = trained(outputs)
    if not bias:
        nn.init.zeros_(source.pool.conv.bias)
    write_port(tmp_path / "checkpoint.pth.tar", source, parallel, bias)
    network = loaded(tmp_path / "checkpoint.pth.tar", outputs)
    assert same(network, source)
    torch.testing.assert_close(network.mean / 255, torch.tensor([0.485, 0.456, 0.406]))
    torch.testing.assert_close(network.std / 255, torch.tensor([0.229, 0.224, 0.225]))


@pytest.mark.parametrize("outputs", [None, OUTPUTS])
def test_the_authors_file(outputs, tmp_path):
    source = trained(outputs)
    nn.init.zeros_(source.pool.conv.bias)
    source.mean.copy_(torch.tensor([123.0, 117, 104]))
    source.std.fill_(1)
    write_mat(tmp_path / "net.mat", source)
    assert same(loaded(tmp_path / "net.mat", outputs), source)
    write_mat(tmp_path / "net.mat", source, conv4_2={"type": "relu", "name": "conv4_2"})
    with pytest.raises(ValueError, match=r"net\.mat lacks weights of the layer conv4_2"):
        read_netvlad_weights(tmp_path / "net.mat")


@torch.no_grad()
def test_whitening_of_matlab_goes_channel_by_channel(tmp_path):
    """MATLAB's vector holds, for each channel, all centres: index d K + k."""
    source = trained()
    write_mat(tmp_path / "net.mat", source)
    found = loaded(tmp_path / "net.mat", OUTPUTS)
    image = torch.randint(0, 256, (1, 3, 32, 32), dtype=torch.uint8)
    scaled = image - found.mean[:, None, None]
    vlad = found.pool(found.encoder(scaled))[0].reshape(CLUSTERS, WIDTHS[-1]).numpy()
    matlab = np.array([vlad[k, d] for d in range(WIDTHS[-1]) for k in range(CLUSTERS)])
    by_centre = array(source.whiten.weight).reshape(OUTPUTS, CLUSTERS, WIDTHS[-1])
    matrix = by_centre.transpose(2, 1, 0).reshape(-1, OUTPUTS)
    expected = unit(matlab @ matrix + array(source.whiten.bias))
    np.testing.assert_allclose(found(image)[0].numpy(), expected, rtol=1e-4, atol=1e-6)
