"""Which activations of a network are features, and taking them."""

import pytest
import torch
from drawings import REAL, needs_real
from helpers import refuses
from networks import Street, colour_network, shared_street, write_published, write_street
from torch import nn

from ssrvlad_torch.segmentation.activations import captured, find_activations
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork

NUMBERS = torch.rand(1, 3, 224, 448, generator=torch.Generator().manual_seed(0))
EXPECTED = {
    "espnetv2": [
        ("/n/level3.2/module_act/PRelu_output_0", 256, 8),
        ("/n/level4.6/module_act/PRelu_output_0", 512, 16),
    ],
    "dabnet": [
        ("/bn_prelu_2/acti/PRelu_output_0", 131, 4),
        ("/bn_prelu_3/acti/PRelu_output_0", 259, 8),
    ],
}


@pytest.fixture(scope="module")
def street_graph(tmp_path_factory):
    return write_street(tmp_path_factory.mktemp("street") / "street.onnx")


def chosen_of(network, names=None, numbers=NUMBERS):
    return [(act.name, act.shape) for act in find_activations(network, numbers, names)]


def test_the_ends_of_the_encoder_at_strides_8_and_16_are_chosen_of(street_graph):
    """Neither the narrow skip after stride 16, nor the wider decoder, nor a smaller picture."""
    shapes = (1, 32, 28, 56), (1, 24, 14, 28)
    assert chosen_of(Street()) == [*zip(("act.2", "act.3"), shapes, strict=True)]
    graph = OnnxNetwork(street_graph)
    assert chosen_of(graph) == [*zip(("relu_2", "relu_3"), shapes, strict=True)]
    assert chosen_of(shared_street()) == [*zip(("act.0#3", "act.0#4"), shapes, strict=True)]


def test_of_a_module_that_runs_several_times_the_chosen_call_is_taken():
    """Its calls have other sizes and other channels."""
    alone, shared = Street(), shared_street()
    assert chosen_of(shared, ["act.0#1"]) == [("act.0#1", (1, 8, 112, 224))]
    with captured(alone, ["act.2"]) as expected, captured(shared, ["act.0#3"]) as values:
        alone(NUMBERS)
        shared(NUMBERS)
    assert torch.equal(values["act.0#3"], expected["act.2"])
    with pytest.raises(ValueError, match=r"no activation 'act\.0'; the nearest are act\.0#\d, act"):
        find_activations(shared, NUMBERS, ["act.0"])


def test_a_module_and_its_graph_give_the_same_activations(street_graph):
    network, graph = Street(), OnnxNetwork(street_graph)
    graph.take(["relu_2"])
    both = graph(NUMBERS, ["relu_2", "scores"])
    with captured(network, ["act.2"]) as values:
        scores = network(NUMBERS)
    torch.testing.assert_close(values["act.2"], both["relu_2"], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(scores, both["scores"], atol=1e-5, rtol=1e-5)
    assert not network._forward_hooks and not network.act[2]._forward_hooks


@needs_real
@pytest.mark.parametrize("name", EXPECTED)
def test_real_networks(name):
    graph = OnnxNetwork(REAL / "networks" / f"{name}_city.onnx")
    chosen = [(a.name, a.shape[1], a.stride) for a in find_activations(graph, NUMBERS)]
    assert chosen == EXPECTED[name]


@pytest.mark.parametrize(
    ("family", "chosen"),
    [
        ("Segformer", {"hidden_states.1": (1, 16, 8, 12), "hidden_states.2": (1, 24, 4, 6)}),
        ("Beit", {"hidden_states.4": (1, 32, 4, 4)}),
        ("Mask2Former", {"hidden_states.1": (1, 32, 8, 12), "hidden_states.2": (1, 64, 4, 6)}),
    ],
)
def test_published_transformers(tmp_path, family, chosen):
    network = open_network(write_published(tmp_path, family)).network.eval()
    numbers = torch.rand(1, 3, 64, 64 if family == "Beit" else 96)
    assert chosen_of(network, numbers=numbers) == [*chosen.items()]
    with torch.no_grad(), captured(network, [*chosen]) as values:
        network(numbers)
    for name, shape in chosen.items():
        assert values[name].shape == shape
        assert values[name].std() > 0


def test_names_choose_other_activations(street_graph):
    names = ["act.3", "act.1"]
    assert chosen_of(Street(), names) == [("act.3", (1, 24, 14, 28)), ("act.1", (1, 16, 56, 112))]
    assert chosen_of(OnnxNetwork(street_graph), ["cat_2"]) == [("cat_2", (1, 35, 28, 56))]


FLAT = nn.Sequential(nn.Conv2d(3, 8, 8, 8), nn.Flatten(), nn.Hardtanh())


@pytest.mark.parametrize(
    ("network", "names", "message"),
    [
        (colour_network(), None, "the encoder has no activation at a stride from 4 to 32; name"),
        (Street(), ["act.7"], r"features: no activation 'act\.7'; the nearest are act\.\d"),
        (nn.Sequential(nn.Conv2d(3, 12, 8, 8)), None, "no activation at a stride"),  # the output
        (FLAT, ["1"], r"\(B, C, h, w\) floats, 1 is \(1, 12544\)"),
    ],
)
def test_what_cannot_be_features_is_refused(network, names, message):
    refuses(message, find_activations, network, NUMBERS, names)
