"""The identity of a network: a digest of its state."""

import copy
import pickle

import pytest
import torch
from drawings import SPACE
from networks import PLAIN, Street
from segmenting import PHOTOS

from ssrvlad_torch.segmentation.identity import digest_of
from ssrvlad_torch.segmentation.segmenter import Segmenter


def trained(network):
    with torch.no_grad():
        network.steps[1].bias[0] += 1e-3
    return network


def narrowed(network):
    return network.half()


def enlarged(network):
    network.more = torch.nn.ReLU()
    return network


@pytest.mark.parametrize("change", [trained, narrowed, enlarged])
def test_another_state_is_another_network(change):
    assert digest_of(change(Street())) != digest_of(Street())


def test_equal_networks_have_one_identity_in_every_process():
    segmenter = Segmenter(Street(), SPACE, PLAIN)
    key = segmenter.key()
    again = pickle.loads(pickle.dumps(segmenter))
    again([PHOTOS[0].repeat(4, 0).repeat(4, 1)])
    assert again.key() == key == Segmenter(copy.deepcopy(Street()), SPACE, PLAIN).key()


def test_training_mode_and_the_features_that_are_taken_change_nothing():
    network = Street()
    segmenter = Segmenter(network, SPACE, PLAIN)
    _ = segmenter.features
    assert digest_of(network.train()) == digest_of(Street())
