"""Networks with features and class probabilities, from ONNX files and with random weights."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from ssrvlad_torch.baselines import dense_network
from ssrvlad_torch.baselines.dense_network import TrunkAndClassifier, load_dense_network


class Small(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.trunk, self.classifier = nn.Conv2d(3, 6, 8, stride=8), nn.Conv2d(6, 4, 1)

    def forward(self, images):
        features = self.trunk(images)
        return features, self.classifier(features).softmax(dim=1)


def write(path: Path, names: list[str]) -> Small:
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
    network = Small().eval()
    image = torch.zeros(1, 3, 32, 48)
    torch.onnx.export(network, (image,), path, output_names=names, dynamo=True, verbose=False)
    return network


def test_an_onnx_file(tmp_path):
    network = write(tmp_path / "lost_x.onnx", ["features", "scores"])
    image = torch.rand(1, 3, 32, 48)
    found = load_dense_network(tmp_path)(image)
    for got, expected in zip(found, network(image), strict=True):
        torch.testing.assert_close(got, expected.detach(), rtol=1e-4, atol=1e-5)


def test_other_outputs_are_named(tmp_path):
    write(tmp_path / "net.onnx", ["features", "logits"])
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
