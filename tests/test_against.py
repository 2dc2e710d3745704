"""A network's ONNX file against the network in PyTorch."""

import json
import warnings
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from drawings import SPACE
from helpers import refuses
from networks import PLAIN, Coloured, colour_network, write_graph, write_street

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment.against import verify_against
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.deployment.verify import verify
from ssrvlad_torch.segmentation.segmenter import Segmenter

SETTINGS = "mean: [0, 0, 0]\nstd: [1, 1, 1]\n"


class Pooled(Coloured):
    """The colour network on areas, an eighth of the picture: of their size Python computes."""

    def forward(self, images):
        sides = [max(1, int(side) // 8) for side in images.shape[2:]]
        small = F.avg_pool2d(images, sides)
        return self.network(F.interpolate(small, images.shape[2:]))


def half():
    return colour_network(0.5)


def write_settings(name="net", network="net.onnx", more=""):
    Path(f"{name}.yaml").write_text(f"network: {network}\n{SETTINGS}{more}")


def export(network, path, size, axes=(0, 2, 3)):
    """The export of a user, by PyTorch's older exporter, which asks for free axes by name."""
    names = {"images": {axis: f"a{axis}" for axis in axes}, "scores": {0: "b", 2: "h", 3: "w"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(), (torch.rand(1, 3, *size),), path, dynamo=False,
            input_names=["images"], output_names=["scores"], dynamic_axes=names,
        )  # fmt: skip
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def by_size(found):
    return {check.size: bool(check.problem) for check in found}


def test_an_export_that_is_right_only_at_its_own_size_is_wrong(folder, ssrvlad):
    export(Pooled(), folder / "net.onnx", (256, 384))
    write_settings()
    for file in ("net.onnx", "net.yaml"):
        found = verify_against(file, "test_against:Pooled")
        assert by_size(found) == {(128, 128): True, (256, 384): False, (512, 768): True}
        assert found[0].other_labels > 0.05 and found[1].other_labels < 1e-3
    command = ("verify", "net.yaml", "--against", "test_against:Pooled")
    code, out, err = ssrvlad(*command)
    assert (code, err) == (1, [])
    assert "WRONG, gives other labels than test_against:Pooled at 128x128, 512x768: " in out
    code, out, _ = ssrvlad(*command, "--json")
    report = json.loads(out)
    assert (code, report["passed"]) == (1, False)
    assert [bool(size["problem"]) for size in report["sizes"]] == [True, False, True]


def test_the_export_of_a_network_gives_its_labels_at_all_sizes(folder, ssrvlad):
    write_street(folder / "street.onnx")
    code, out, err = ssrvlad("verify", "street.onnx", "--against", "networks:Street")
    assert (code, err) == (0, [])
    assert "gives the labels of networks:Street at 128x128, 256x384, 512x768" in out
    write_settings("pooled", "test_against:Pooled", "size: [64, 96]\n")
    export(Pooled(), folder / "fixed.onnx", (64, 96), axes=(0,))
    for network in ("test_against:Pooled", "pooled.yaml"):
        found = verify_against("fixed.onnx", network)
        assert not any(check.problem for check in found)
        assert {check.fed for check in found} == {(64, 96)}


def test_other_weights_and_other_preparation_are_wrong(folder):
    write_graph(folder / "net.onnx")
    write_settings()
    write_settings("module", "networks:colour_network")
    write_settings("bgr", "networks:colour_network", "colour_order: bgr\n")
    assert not any(by_size(verify_against("net.onnx", "module.yaml")).values())
    assert all(by_size(verify_against("net.yaml", "bgr.yaml")).values())
    assert all(by_size(verify_against("net.yaml", "test_against:half")).values())


def test_a_fused_file_is_compared_with_its_network(folder, coloured):
    place = coloured / "place.onnx"
    assert not any(by_size(verify_against(place, "networks:colour_network")).values())
    assert all(by_size(verify_against(place, "test_against:half")).values())
    export(Pooled(), folder / "net.onnx", (256, 384))
    write_settings()
    fuse(folder / "net.yaml", SSRVLADConfig(labels_as=SPACE), folder / "wrong.onnx")
    assert verify(folder / "wrong.onnx").passed, "files are compared with files"
    found = verify_against("wrong.onnx", "test_against:Pooled")
    assert by_size(found) == {(128, 128): True, (256, 384): False, (512, 768): True}


@pytest.mark.parametrize("size", [None, pytest.param((64, 96), marks=pytest.mark.slow)])
def test_fuse_says_that_a_traced_graph_depends_on_the_size(tmp_path, size):
    segmenter = Segmenter(Pooled(), SPACE, PLAIN, size=size)
    if size:
        fuse(segmenter, SSRVLADConfig(labels_as=SPACE), tmp_path / "place.onnx")
        return
    message = (
        r"of a golden image, .*the graph fails.* for the traced size; .* size: \[H, W\] in a YAML"
    )
    refuses(message, fuse, segmenter, SSRVLADConfig(labels_as=SPACE), tmp_path / "place.onnx")
