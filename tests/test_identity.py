"""The identity of a network, and what no longer has it."""

import copy
import pickle

import numpy as np
import pytest
import torch
from drawings import SPACE
from helpers import refused
from networks import PLAIN, Street
from segmenting import PHOTOS, write_photos
from torch import nn

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.channels.channel import new_channels
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.results import EncodeOptions
from ssrvlad_torch.segmentation import segmenter as segmentation
from ssrvlad_torch.segmentation.identity import ChangedError
from ssrvlad_torch.segmentation.segmenter import Segmenter

PHOTO = PHOTOS[0].repeat(4, 0).repeat(4, 1)


def street():
    """`Street` with normalisation and dropout."""
    network = Street()
    norm, dropout = nn.BatchNorm2d(32), nn.Dropout(0.5)
    network.narrow = nn.Sequential(network.narrow, norm, dropout, dropout)
    return network


def step(network):
    with torch.no_grad():
        network.steps[1].bias.add_(0.1)


def load(network):
    network.load_state_dict(copy.deepcopy(network.state_dict()))


def replace(network):
    network.scores.bias = nn.Parameter(network.scores.bias + 1)


def exchange(network):
    network.scores = nn.Conv2d(64, 12, 1).eval()


def share(network):
    """One module in two places, in place of another."""
    network.narrow[3] = network.narrow[1]


def drift(network):
    """Of the statistics alone."""
    network.train()
    network(torch.rand(2, 3, 96, 128))
    network.eval()


CHANGES = {
    step: r"identity \(steps\.1\.bias\)",
    load: r"identity \(steps\.0\.weight\)",
    replace: r"identity \(scores\.bias\)",
    exchange: r"identity \(scores\.weight\)",
    share: r"identity \(narrow\.3",
    drift: r"identity \(narrow\.1\.running_mean\)",
    nn.Module.half: r"identity \(steps\.0\.weight\)",
    nn.Module.train: r"in training mode \(the whole\), where labels differ: call eval\(\) on it",
    lambda network: network.narrow[2].train(): r"in training mode \(narrow\.2\)",
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("features", [False, True])
def test_a_network_that_was_changed_is_refused_in_one_line(change, features):
    segmenter = Segmenter(street(), SPACE, PLAIN)
    _ = segmenter.features if features else segmenter.key()
    segmenter.segment([PHOTO], features)
    change(segmenter.network)
    for use in (segmenter.key, lambda: segmenter.segment([PHOTO], features)):
        with refused(CHANGES[change], by=ChangedError):
            use()


def test_a_change_of_all_weights_past_the_counters_is_refused():
    segmenter = Segmenter(street(), SPACE, PLAIN)
    _ = segmenter.features
    for weights in segmenter.network.parameters():
        weights.data *= 0.9
    with refused(r"identity \(steps\.0\.weight\)", by=ChangedError):
        segmenter.segment([PHOTO], features=True)


def test_a_change_of_one_number_past_the_counters_is_noticed_by_the_next_key():
    segmenter = Segmenter(street(), SPACE, PLAIN)
    _ = segmenter.features
    segmenter.network.steps[0].bias.data[0] += 0.1
    with refused("the network has other weights, or gives other labels, than", by=ChangedError):
        segmenter.key()


def test_a_network_without_an_identity_may_change_but_not_be_in_training():
    """As where a training measures itself."""
    network = street()
    segmenter = Segmenter(network, SPACE, PLAIN)
    step(network)
    network.train()
    with pytest.raises(ChangedError, match="in training mode"):
        _ = segmenter.problem_of_features
    network.eval()
    segmenter([PHOTO])
    assert segmenter.key() == Segmenter(network, SPACE, PLAIN).key()


def test_another_process_takes_the_identity_anew():
    segmenter = Segmenter(street(), SPACE, PLAIN)
    key = segmenter.key()
    again = pickle.loads(pickle.dumps(segmenter))
    again([PHOTO])
    assert again.key() == key


class Grid(nn.Module):
    """It keeps what it makes for a size, for the next picture of this size."""

    def __init__(self):
        super().__init__()
        self.network = Street()
        self.register_buffer("grid", torch.zeros(1), persistent=False)

    def forward(self, images):
        if self.grid.shape != images.shape[2:]:
            self.register_buffer("grid", torch.zeros(images.shape[2:]), persistent=False)
        return self.network(images + self.grid)


def test_a_buffer_that_is_not_saved_may_change():
    segmenter = Segmenter(Grid(), SPACE, PLAIN)
    key = segmenter.key()
    segmenter([PHOTO])
    assert segmenter.key() == key


def test_no_frame_is_stored_under_the_identity_of_another_network(tmp_path, monkeypatch):
    """The network changes after 18 of 20 pictures: the first batch of 16 is stored."""
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
    files = find_image_files([str(write_photos(tmp_path / "photos", range(20), (96, 128)))])
    network, head = street(), SSRVLAD.from_preset("default", labels_as=SPACE)
    segmenter, seen = Segmenter(network, SPACE, PLAIN), []

    def change(module, inputs, output):
        seen.extend(inputs[0].shape[2:] == (96, 128) for _ in inputs)
        if sum(seen) == 18:
            step(module)

    network.register_forward_hook(change)
    columns = [channel.column for channel in new_channels(None, head, segmenter)[1:]]
    database = Database.create(tmp_path / "town", head.config, columns=columns)
    with pytest.raises(ChangedError, match=r"steps\.1\.bias"):
        encode_to_database(head, files, database, EncodeOptions(workers=1), segmenter)
    assert (sum(seen), len(database)) == (18, 16)
    pictures = [read_image(file) for file in files[:16]]
    expected = [
        result.features for result in Segmenter(street(), SPACE, PLAIN).segment(pictures, True)
    ]
    np.testing.assert_array_equal(database.load().channels["features"].numpy(), expected)
