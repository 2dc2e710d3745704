"""Where weights are looked for, what is read of a checkpoint, and what is refused."""

from pathlib import Path

import pytest
import torch
from helpers import refused, refuses
from torch import nn

from ssrvlad_torch.baselines import weights
from ssrvlad_torch.baselines.weights import fill, find_weights, read_checkpoint


def layer(seed: int = 0) -> nn.Linear:
    torch.manual_seed(seed)
    return nn.Linear(2, 3)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestFinding:
    def test_a_file_or_a_published_name_in_a_folder_is_found(self, home):
        file = home / "unzipped" / "b.pth"
        file.parent.mkdir()
        file.touch()
        for where in (file, str(file), home):
            assert find_weights(where, ["a.mat", "unzipped/b.pth"], "them") == file
        (home / "a.mat").touch()
        assert find_weights(home, ["a.mat", "unzipped/b.pth"], "them") == home / "a.mat"

    def test_the_cache_folder_is_searched_by_default(self, home):
        assert weights.weights_folder() == home / ".cache" / "ssrvlad" / "weights"
        weights.weights_folder().mkdir(parents=True)
        (weights.weights_folder() / "a.mat").touch()
        assert find_weights(None, ["a.mat"], "them") == weights.weights_folder() / "a.mat"

    @pytest.mark.parametrize("where", [None, "nowhere.mat", "."])
    def test_missing_weights_are_named_in_one_line(self, where, home):
        place = where or str(weights.weights_folder())
        with refused("a.mat or b.pth", "the project page", place, by=FileNotFoundError) as error:
            find_weights(where, ["a.mat", "b.pth"], "the project page")
        assert str(weights.weights_folder()) in str(error.value)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.pth.tar"


class TestReading:
    @pytest.mark.parametrize("wrap", [lambda s: s, lambda s: {"state_dict": s, "epoch": 7}])
    @pytest.mark.parametrize("zipped", [True, False])
    def test_tensors_are_read_bare_or_wrapped_from_both_formats(self, wrap, zipped, path):
        state = layer().state_dict()
        torch.save(wrap(state), path, _use_new_zipfile_serialization=zipped)
        read = read_checkpoint(path)
        assert read.keys() == state.keys()
        assert all(torch.equal(read[name], state[name]) for name in state)

    def test_code_is_refused(self, path):
        torch.save({"a": torch.ones(2), "b": Path("x")}, path)
        refuses(r"checkpoint\.pth\.tar.*Weights only load failed", read_checkpoint, path)

    @pytest.mark.parametrize("keep", [0, 10, 0.5, 0.95])
    @pytest.mark.parametrize("zipped", [True, False])
    def test_a_damaged_file_is_named(self, keep, zipped, path):
        torch.save(layer().state_dict(), path, _use_new_zipfile_serialization=zipped)
        content = path.read_bytes()
        path.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
        refuses(r"checkpoint\.pth\.tar is not a whole", read_checkpoint, path)

    @pytest.mark.parametrize("content", [{}, {"state_dict": {}}, [torch.ones(1)], {"epoch": 1}])
    def test_a_file_without_tensors_is_refused(self, content, path):
        torch.save(content, path)
        refuses("must hold tensors by name", read_checkpoint, path)


class TestFilling:
    def test_a_network_on_the_meta_device_is_filled_with_the_tensors_that_it_has(self):
        with torch.device("meta"):
            network = nn.Linear(2, 3)
        state = {name: tensor.half() for name, tensor in layer(1).state_dict().items()}
        fill(network, {**state, "other": torch.ones(1)}, Path("x"))
        assert torch.equal(network.weight, layer(1).weight.half().float())

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"bias": None}, r"file\.pth lacks bias \(3,\); it has weight"),
            ({"bias": torch.ones(4)}, r"file\.pth: bias must be \(3,\), got \(4,\)"),
            ({"weight": torch.full((3, 2), torch.nan)}, r"file\.pth: weight holds values"),
        ],
    )
    def test_a_tensor_that_does_not_fit_is_refused_and_nothing_is_copied(self, change, message):
        network = layer(0)
        changed = {**layer(1).state_dict(), **change}
        state = {name: value for name, value in changed.items() if value is not None}
        refuses(message, fill, network, state, Path("file.pth"))
        assert torch.equal(network.weight, layer(0).weight)
