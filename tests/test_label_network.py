"""A network that gives label maps: its settings and its outputs."""

import pytest
import torch
from drawings import SPACE
from helpers import street
from networks import PLAIN, colour_network, photo, write_graph
from segmenting import BYTES, assert_right
from torch import nn

from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter


def test_a_graph_that_takes_bytes_needs_white_255(tmp_path):
    shape = (1, 24, 32, 3)
    path = write_graph(tmp_path / "net.onnx", shape, "bytes", channels_last=True, white=255)
    assert_right(Segmenter(OnnxNetwork(path), SPACE, BYTES))
    with pytest.raises(ValueError, match=r"net\.onnx: takes bytes: expected white 255, got 1"):
        Segmenter(OnnxNetwork(path), SPACE)


def test_a_fixed_size_is_the_size_of_the_settings(tmp_path):
    path = write_graph(tmp_path / "net.onnx", (1, 3, 24, 32))
    segmenter = Segmenter(OnnxNetwork(path), SPACE)
    assert segmenter.config.size == (24, 32)
    assert segmenter([photo(street(0, 50, 70))])[0].shape == (50, 70)
    with pytest.raises(ValueError, match="takes images of 24x32, the settings say 32x32"):
        Segmenter(OnnxNetwork(path), SPACE, SegmenterConfig(size=(32, 32)))
    path = write_graph(tmp_path / "net.onnx", (1, 3, 24, "w"))
    with pytest.raises(ValueError, match="takes images of 24xany; expected a size"):
        Segmenter(OnnxNetwork(path), SPACE)


def test_an_ambiguous_graph_names_its_candidates(tmp_path):
    path = write_graph(tmp_path / "net.onnx", aux=True)
    expected = r"net\.onnx: several outputs could be labels: found \(\?, 12, \?, \?\) tensor"
    with pytest.raises(ValueError, match=expected):
        Segmenter(OnnxNetwork(path), SPACE)
    with pytest.raises(ValueError, match=r"no output fits .*cityscapes-trainids.* = 19"):
        Segmenter(OnnxNetwork(path), "cityscapes-trainids")


def test_the_network_is_in_evaluation_mode_and_takes_no_gradients():
    network = nn.Sequential(colour_network(), nn.Dropout(0.9))
    network[0].weight.requires_grad_(True)
    assert_right(Segmenter(network.train(), SPACE, PLAIN))
    assert not network.training


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_the_network_runs_where_its_weights_lie():
    assert_right(Segmenter(colour_network().cuda(), SPACE, PLAIN))
