"""Networks with features and class probabilities, from ONNX files and with random weights."""

import numpy as np
import onnx
import pytest
import torch
from plain_layers import Array, convolve, relu
from torch import nn

from ssrvlad_torch.baselines import dense_network
from ssrvlad_torch.baselines.dense_network import (
    Bottleneck,
    TrunkAndClassifier,
    load_dense_network,
    resnet101,
)
from ssrvlad_torch.onnx_files import rename


class Small(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.trunk, self.classifier = nn.Conv2d(3, 6, 8, stride=8), nn.Conv2d(6, 4, 1)

    def forward(self, images):
        features = self.trunk(images)
        return features, self.classifier(features).softmax(dim=1)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A file of the network, and the network."""
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
    network, path = Small().eval(), tmp_path_factory.mktemp("net") / "lost_x.onnx"
    image, names = torch.zeros(1, 3, 32, 48), ["features", "scores"]
    torch.onnx.export(network, (image,), path, output_names=names, dynamo=True, verbose=False)
    return path, network


def test_an_onnx_file(exported):
    path, network = exported
    image = torch.rand(1, 3, 32, 48)
    found = load_dense_network(path.parent)(image)
    for got, expected in zip(found, network(image), strict=True):
        torch.testing.assert_close(got, expected.detach(), rtol=1e-4, atol=1e-5)


def test_other_outputs_are_named(exported, tmp_path):
    model = onnx.load(exported[0])
    rename(model.graph, lambda name: {"scores": "logits"}.get(name, name))
    onnx.save(model, tmp_path / "net.onnx")
    with pytest.raises(ValueError, match="must have the outputs features and scores, it has feat"):
        load_dense_network(tmp_path / "net.onnx")


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"lost_x\.onnx.*RefineNet-101") as error:
        load_dense_network(tmp_path)
    assert "\n" not in str(error.value)


@torch.no_grad()
def test_trunk_and_classifier(monkeypatch):
    monkeypatch.setattr(dense_network, "resnet101", lambda: nn.Conv2d(3, 2048, 32, stride=32))
    features, probabilities = TrunkAndClassifier(19)(torch.rand(2, 3, 64, 96))
    assert features.shape == (2, 2048, 2, 3)
    assert probabilities.shape == (2, 19, 2, 3)
    torch.testing.assert_close(probabilities.sum(dim=1), torch.ones(2, 2, 3))


def test_it_has_the_published_size():
    """44,549,160 with the classifier of 2048 x 1000 + 1000."""
    with torch.device("meta"):
        network = resnet101()
    assert sum(p.numel() for p in network.parameters()) == 44_549_160 - 2_049_000
    assert sum(isinstance(m, nn.Conv2d) for m in network.modules()) == 100 + 4  # and 4 shortcuts


@torch.no_grad()
def test_its_stride_is_32():
    assert resnet101().eval()(torch.zeros(1, 3, 65, 96)).shape == (1, 2048, 3, 3)


@torch.no_grad()
@pytest.mark.parametrize(("channels", "stride"), [(8, 1), (8, 2), (5, 1)])
def test_a_block_is_three_convolutions_beside_a_shortcut(channels, stride):
    torch.manual_seed(0)
    block = Bottleneck(channels, 2, stride).double().eval()
    for norm in block.modules():
        if isinstance(norm, nn.BatchNorm2d):
            for tensor in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
                tensor.copy_(torch.rand_like(tensor) + 0.5)

    def layer(part: nn.Sequential, maps: Array) -> Array:
        conv, norm = part
        scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).numpy()
        zero = np.zeros(conv.out_channels)
        maps = convolve(maps, conv.weight.numpy(), zero, conv.stride[0], conv.padding[0])
        shift = norm.bias.numpy() - norm.running_mean.numpy() * scale
        return maps * scale[:, None, None] + shift[:, None, None]

    image = torch.randn(channels, 5, 6, dtype=torch.float64)
    x = image.numpy()
    first, _, second, _, third = block.residual
    changes = (channels, stride) != (8, 1)
    beside = layer(block.shortcut, x) if changes else x
    expected = relu(layer(third, relu(layer(second, relu(layer(first, x))))) + beside)
    np.testing.assert_allclose(block(image[None])[0].numpy(), expected, rtol=1e-9, atol=1e-12)
