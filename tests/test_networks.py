"""Networks by name: files of settings, functions, published models."""

import sys

import pytest
import torch
from drawings import SPACE
from helpers import refused, refuses
from networks import (
    NAMES,
    NOISE,
    PHOTOS,
    PLAIN,
    assert_right,
    colour_network,
    write_graph,
    write_published,
)

from ssrvlad_torch.segmentation.networks import open_network, runs_code
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter


def test_a_settings_file_names_a_network_beside_it(tmp_path, monkeypatch):
    (tmp_path / "nets").mkdir()
    write_graph(tmp_path / "nets" / "net.onnx", aux=True)
    (tmp_path / "nets" / "net.yaml").write_text(
        "network: net.onnx\nsize: [24, 32]\nmean: [0, 0, 0]\nstd: [1, 1, 1]\noutput: found\n"
        f"classes: 0:12\nlabels_as: {SPACE}\n"
    )
    monkeypatch.chdir(tmp_path)
    segmenter = Segmenter.load("nets/net.yaml")
    assert segmenter.config == SegmenterConfig(
        size=(24, 32), mean=(0, 0, 0), std=(1, 1, 1), output="found", classes=(0, 12)
    )
    assert_right(segmenter)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"cannot read the settings .*net\.yaml: No such file"),
        ("network: other.yaml", "expected a network, got another file of settings, other.yaml"),
        ("network: [", r"^\S*net\.yaml is not plain YAML: while parsing"),
        ("size: [4, 4]", r"net\.yaml names no network; expected network: NAME"),
        ("network: net.onnx\nmeans: 3", r"^\S*net\.yaml: unknown setting 'means'; expected net"),
        ("network: net.onnx\nclasses: 3-4", r"classes must be FIRST:LAST"),
        ("network: none.onnx", r"none\.onnx does not exist"),
        ("network: none", r"no network 'none'; expected FILE.onnx"),
    ],
)
def test_a_bad_settings_file_is_an_error_in_one_line(tmp_path, text, message):
    if text is not None:
        (tmp_path / "net.yaml").write_text(text)
    refuses(message, Segmenter.load, tmp_path / "net.yaml", SPACE)


def test_a_function_makes_the_network(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mynets.py").write_text("from networks import colour_network as mine\n")
    assert_right(Segmenter(open_network("mynets:mine").network, SPACE, PLAIN))
    refuses("does not name its classes; give --labels-as", Segmenter.load, "mynets:mine")


@pytest.mark.parametrize("name", ["builtins:none", "nothing:mine", "torchhub:strided"])
def test_a_function_that_is_not_there_is_named(name):
    refuses(f"no network '{name}'", open_network, name)


def test_a_module_and_its_weights_are_found_beside_the_settings(tmp_path, monkeypatch):
    """From any folder; and a module of this name from elsewhere is not taken for it."""
    nets, elsewhere = tmp_path / "nets", tmp_path / "elsewhere"
    code = (
        "import torch\nfrom networks import colour_network\ndef mine(weights):\n"
        "    network = colour_network()\n"
        "    network.load_state_dict(torch.load(weights, weights_only=True))\n"
        "    return network\n"
    )
    settings = "network: beside_yaml:mine\narguments: {weights: best.pth}\nmean: [0, 0, 0]\n"
    for folder in (nets, elsewhere):
        folder.mkdir()
        (folder / "beside_yaml.py").write_text(code)
        (folder / "net.yaml").write_text(settings + "std: [1, 1, 1]\n")
        torch.save(colour_network().state_dict(), folder / "best.pth")
    monkeypatch.chdir(tmp_path)
    assert_right(Segmenter.load("nets/net.yaml", SPACE))
    assert str(nets) not in sys.path
    with pytest.raises(ValueError, match=r"beside_yaml is loaded already, .*nets/.*; rename .*els"):
        open_network(elsewhere / "net.yaml")
    (nets / "net.yaml").write_text(settings.replace("best", "none"))
    message = r"^beside_yaml:mine\(weights: none\.pth\) fails: none\.pth: No such file"
    refuses(message, open_network, "nets/net.yaml")


def test_weights_alone_are_refused_with_what_they_need(tmp_path, refusal):
    torch.save(colour_network().state_dict(), tmp_path / "net.pth")
    (tmp_path / "net.yaml").write_text("network: net.pth\n")
    for name in ("net.pth", "net.yaml"):
        message = "net.pth can only be the weights of a network; expected MODULE:NAME, a function"
        assert message in refusal("labels", tmp_path / name)
    (tmp_path / "code.yaml").write_text("network: broken_code:mine\n")
    (tmp_path / "broken_code.py").write_text("def mine(:\n")
    assert "no network 'broken_code:mine': invalid syntax" in refusal(
        "labels", tmp_path / "code.yaml"
    )
    (tmp_path / "code.yaml").write_text("network: net.pth\narguments: 3\n")
    assert "arguments must be names with values, got 3" in refusal("labels", tmp_path / "code.yaml")


@pytest.fixture(scope="module")
def hub_folder(tmp_path_factory):
    """A tiny SegFormer with random weights, as transformers saves it."""
    return write_published(tmp_path_factory.mktemp("hub") / "tiny")


def test_a_published_model_comes_with_its_own_settings_and_class_names(hub_folder):
    from transformers import AutoImageProcessor

    segmenter = Segmenter.load(f"hf:{hub_folder}")
    assert segmenter.config == SegmenterConfig(size=(64, 96))
    kinds = [label.category for label in segmenter.label_space.classes]
    assert kinds == ["ground", *NAMES[1:6], "dynamic", "void"]
    processor = AutoImageProcessor.from_pretrained(hub_folder, backend="pil")
    theirs = processor(PHOTOS[0], return_tensors="pt")["pixel_values"]
    ours = segmenter.labels.preparation(torch.from_numpy(PHOTOS[0])[None])
    assert (ours - theirs).abs().max() < 1.01 / 255 / 0.224, "they round to bytes"
    assert segmenter([NOISE])[0].shape == (17, 23)


@pytest.mark.parametrize("family", ["Mask2Former", pytest.param("Beit", marks=pytest.mark.slow)])
def test_every_family_of_transformers_gives_label_maps(family, tmp_path):
    segmenter = Segmenter.load(write_published(tmp_path / "tiny", family))
    labels = segmenter([PHOTOS[0], NOISE])
    assert [image.shape for image in labels] == [(24, 32), (17, 23)]
    assert len(segmenter.label_space.classes) == 8
    size = (64, 128) if family == "Mask2Former" else (64, 64)
    assert segmenter.config.network_size(90, 160) == size


def test_a_model_that_is_not_there_is_an_error_in_one_line(tmp_path, monkeypatch, capfd):
    pytest.importorskip("transformers")
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with refused(r"^hf:nobody/nothing@1 cannot be loaded: ", by=OSError):
        open_network("hf:nobody/nothing@1")
    (tmp_path / "empty").mkdir()
    refuses("empty cannot be used: Unrecognized model", open_network, tmp_path / "empty")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("network", "code"), [("net.onnx", False), ("hf:ORG/NAME", False), ("nets:mine", True)]
)
def test_names_and_files_that_run_code_are_known(tmp_path, network, code):
    (tmp_path / "net.yaml").write_text(f"network: {network}\n")
    assert runs_code(network) == code
    assert runs_code(str(tmp_path / "net.yaml")) == code
