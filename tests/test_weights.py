"""Where weights are looked for, what is read of a checkpoint, and what is refused."""

from pathlib import Path

import pytest
import torch
from helpers import refused, refuses
from torch import nn

from ssrvlad_torch.baselines import weights
from ssrvlad_torch.baselines.netvlad import read_checkpoint
from ssrvlad_torch.baselines.weights import fill, find_weights


def layer(seed: int = 0) -> nn.Linear:
    torch.manual_seed(seed)
    return nn.Linear(2, 3)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_file_or_a_published_name_in_a_folder_is_found(home):
    """By default in the cache."""
    file, cached = home / "unzipped" / "b.pth", home / ".cache" / "ssrvlad" / "weights" / "b.pth"
    for path in (file, cached):
        path.parent.mkdir(parents=True)
        path.touch()
    for where in (file, str(file), home):
        assert find_weights(where, ["a.mat", "unzipped/b.pth"], "them") == file
    assert find_weights(None, ["b.pth"], "them") == cached


@pytest.mark.parametrize("where", [None, "nowhere.mat", "."])
def test_missing_weights_are_named_in_one_line(where, home):
    place = where or str(weights.weights_folder())
    with refused("a.mat or b.pth", "the project page", place, by=FileNotFoundError) as error:
        find_weights(where, ["a.mat", "b.pth"], "the project page")
    assert str(weights.weights_folder()) in str(error.value)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.pth.tar"


@pytest.mark.parametrize("zipped", [True, False])
def test_what_is_no_whole_checkpoint_is_refused(zipped, path):
    torch.save(layer().state_dict(), path, _use_new_zipfile_serialization=zipped)
    content = path.read_bytes()
    for length in (0, 10, len(content) // 2, len(content) * 19 // 20):
        path.write_bytes(content[:length])
        refuses(r"checkpoint\.pth\.tar is not a whole", read_checkpoint, path)
    torch.save({"a": torch.ones(2), "b": Path("x")}, path)
    refuses(r"checkpoint\.pth\.tar.*Weights only load failed", read_checkpoint, path)


@pytest.mark.parametrize("content", [{}, {"state_dict": {}}, [torch.ones(1)], {"epoch": 1}])
def test_a_file_without_tensors_is_refused(content, path):
    torch.save(content, path)
    refuses("must hold tensors by name", read_checkpoint, path)


def test_a_network_on_the_meta_device_is_filled_with_the_tensors_that_it_has():
    with torch.device("meta"):
        network = nn.Linear(2, 3)
    state = {name: tensor.half() for name, tensor in layer(1).state_dict().items()}
    fill(network, {**state, "other": torch.ones(1)}, Path("x"))
    assert torch.equal(network.weight, layer(1).weight.half().float())


@pytest.mark.parametrize(
    ("bias", "message"),
    [
        ({}, r"file\.pth: lacks bias; it has weight"),
        ({"bias": torch.ones(4)}, r"file\.pth: .*size mismatch for bias: "),
    ],
)
def test_a_tensor_that_does_not_fit_is_refused(bias, message):
    refuses(message, fill, layer(), {"weight": torch.ones(3, 2), **bias}, Path("file.pth"))
