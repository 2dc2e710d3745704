"""NetVLAD as a method: a real-sized file, its descriptors, its errors."""

from pathlib import Path

import numpy as np
import pytest
import torch
from test_netvlad_weights import write_port

from ssrvlad_torch.baselines import Frame, make
from ssrvlad_torch.baselines.netvlad import NetVLAD
from ssrvlad_torch.baselines.netvlad_network import NetVLADNetwork


def frame(seed: int, height: int = 32, width: int = 48) -> Frame:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    return Frame(f"drive/{seed}", image=pixels)


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


def test_it_is_the_network_on_each_frame(checkpoint):
    folder, network = checkpoint
    method = NetVLAD(folder)
    assert (method.name, method.needs) == ("netvlad", {"images", "weights"})
    frames = [frame(0), frame(1, 40, 64), frame(0)]
    found = method.encode_query(frames)
    assert found.shape == (3, 32768)
    with torch.no_grad():
        expected = [network(torch.tensor(f.image).permute(2, 0, 1)[None])[0] for f in frames]
    torch.testing.assert_close(found, torch.stack(expected))
    assert torch.equal(method.encode_reference(frames), found)
    scores = method.scores(found, found[:2])
    torch.testing.assert_close(scores, found @ found[:2].T)
    torch.testing.assert_close(scores[[0, 1, 2], [0, 1, 0]], torch.ones(3))
    assert method.encode_query([]).shape == (0, 32768)


def test_frames_that_do_not_do_are_named(checkpoint):
    method = NetVLAD(checkpoint[0])
    with pytest.raises(ValueError, match="method netvlad needs images, but frame drive/1"):
        method.encode_query([Frame("drive/1")])
    with pytest.raises(ValueError, match="at least 16 x 16 pixels, got 15 x 40"):
        method.encode_query([frame(0, 15, 40)])


def test_missing_weights_are_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    with pytest.raises(FileNotFoundError) as error:
        make("netvlad")
    for part in ("vd16_pitts30k_conv5_3", "di.ens.fr", "Nanne/pytorch-NetVlad", str(tmp_path)):
        assert part in str(error.value)
    assert "\n" not in str(error.value)


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
    assert method.encode_query([frame(0)]).shape == (1, 3)
