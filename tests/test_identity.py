"""The identity of a network: a digest of its state."""

import copy
import pickle

from drawings import SPACE
from networks import PLAIN, Street
from segmenting import PHOTOS

from ssrvlad_torch.segmentation.identity import digest_of
from ssrvlad_torch.segmentation.segmenter import Segmenter


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
