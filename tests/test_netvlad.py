"""NetVLAD as a method: a real-sized file, its descriptors, its errors."""

from pathlib import Path

import pytest
import torch
from helpers import refused
from methods import frames, noise
from test_netvlad_weights import write_port

from ssrvlad_torch.baselines import make
from ssrvlad_torch.baselines.netvlad import NetVLAD
from ssrvlad_torch.baselines.netvlad_network import NetVLADNetwork
from ssrvlad_torch.channels.channel import View


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
    with pytest.raises(ValueError, match="netvlad needs pictures, but frame drive/1"):
        method.encode_query([View("drive/1")])
    with pytest.raises(ValueError, match="at least 16 x 16 pixels, got 15 x 40"):
        method.encode_query(frames([noise(0, 15, 40)]))


def test_missing_weights_are_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    origin = "vd16_pitts30k_conv5_3.*di.ens.fr.*Nanne/pytorch-NetVlad"
    with refused(origin, tmp_path, by=FileNotFoundError):
        make("netvlad")


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
