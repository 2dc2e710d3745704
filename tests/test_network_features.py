"""The features of a network, in the pass that labels pictures."""

import numpy as np
import pytest
import torch
from drawings import REAL, SPACE, needs_real
from helpers import refuses
from networks import (
    PHOTOS,
    PLAIN,
    Street,
    colour_network,
    counted,
    shared_street,
    write_photos,
    write_published,
    write_street,
)
from torch import nn

from ssrvlad_torch import reference
from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.deployment.differences import other_signs
from ssrvlad_torch.segmentation.activations import captured, find_activations
from ssrvlad_torch.segmentation.features import NOISE, PROBES, pink_noise
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.stages.features import SHAPE


def pictures(count=3, size=(96, 128)):
    return list(np.random.default_rng(0).integers(0, 256, (count, *size, 3), np.uint8))


def test_features_are_the_signs_of_the_activations(tmp_path):
    """Of two levels, with projections of noise."""
    network, images = Street(), pictures()

    def activations_of(picture):
        with captured(network, ["act.2", "act.3"]) as values:
            network(segmenter.labels.preparation(torch.from_numpy(picture)[None]))
        return [values[name][0].double().numpy() for name in ("act.2", "act.3")]

    for form in (network, OnnxNetwork(write_street(tmp_path / "net.onnx"))):
        segmenter = Segmenter(form, SPACE, PLAIN)
        labels, (first, *_) = segmenter(images), segmenter.segment(images, features=True)
        noise = [activations_of(pink_noise(number, *PROBES[0])) for number in range(NOISE)]
        expected = reference.features(activations_of(images[0]), noise)
        assert first.features.shape == SHAPE
        assert segmenter.segment(images[:1])[0].features is None
        assert other_signs(first.features, expected) < 2e-3
        np.testing.assert_array_equal(first.labels, labels[0])


def test_pink_noise_has_the_spectrum_of_photographs():
    """Each octave of frequencies has the same power, in every colour; no two pictures are alike."""
    first, second = (pink_noise(n, 128, 256).astype(float) for n in range(2))
    assert first.shape == (128, 256, 3) and first.dtype == float
    assert np.array_equal(first, pink_noise(0, 128, 256))
    together = np.concatenate([first, second], 2).reshape(-1, 6)
    assert abs(np.corrcoef(together.T) - np.eye(6)).max() < 0.3
    power = abs(np.fft.fft2(first[:128, :128], axes=(0, 1))) ** 2
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(128, 1 / 128)] * 2))
    octaves = [power[(low <= frequency) & (frequency < 2 * low)].sum(0) for low in (4, 8, 16)]
    assert np.ptp(octaves, axis=0).max() < 0.5 * np.min(octaves)


def test_the_fingerprint_is_of_the_network_its_settings_and_the_activations():
    other = Street()
    other.steps[0].bias.data += 1
    segmenters = [
        Segmenter(Street(), SPACE, PLAIN),
        Segmenter(other, SPACE, PLAIN),
        Segmenter(Street(), SPACE, PLAIN, white=255),
        Segmenter(Street(), SPACE, PLAIN, features=["act.1"]),
    ]
    assert len({segmenter.features.fingerprint for segmenter in segmenters}) == 4
    again = Segmenter(Street(), SPACE, PLAIN, features=["act.2", "act.3"])
    assert again.features.fingerprint == segmenters[0].features.fingerprint
    assert again.key() == segmenters[0].key() == segmenters[3].key()
    assert "128 signs of act.2, act.3, " in again.features.fingerprint


def test_label_maps_and_features_are_cached_together(tmp_path):
    files = find_image_files([str(write_photos(tmp_path / "photos", size=(96, 128)))])
    network = counted(Street())

    def run(features, names=None):
        """The results, and how many pictures the network was given for them."""
        segmenter = Segmenter(network, SPACE, PLAIN, tmp_path / "cache", features=names)
        if features:
            _ = segmenter.features
        before = int(network.images)
        results = [result for _, result in segmenter.segmented(files, features=features)]
        return results, int(network.images) - before

    def same(one, other):
        return all(
            np.array_equal(a.labels, b.labels) and np.array_equal(a.features, b.features)
            for a, b in zip(one, other, strict=True)
        )

    assert run(False)[1] == 5  # labels alone
    made, count = run(True)
    assert count == 5
    stored, count = run(True)
    assert count == 0 and same(made, stored)
    assert run(False)[1] == 0
    others, count = run(True, ("act.1",))
    assert count == 5 and not same(made, others)
    (entry, *_) = (tmp_path / "cache").rglob("*.npz")
    entry.write_bytes(entry.read_bytes()[:-40])
    again, count = run(True, ("act.1",))
    assert count == 1 and same(again, others)


def test_torchscript_is_refused():
    program = torch.jit.trace(Street(), torch.rand(1, 3, 96, 128), check_trace=False)
    for network in (program, nn.Sequential(nn.Identity(), program)):
        refuses("expected the module of which the TorchScript was made", Segmenter, network, SPACE)


def same_everywhere(value):
    """A network whose activations do not depend on the picture."""
    network = nn.Sequential(nn.Conv2d(3, 8, 8, 8), nn.Hardtanh(), nn.Conv2d(8, 12, 1))
    nn.init.constant_(network[0].weight, value)
    return network


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (colour_network(), "the encoder has no activation at a stride from 4 to 32"),
        (same_everywhere(0.0), "the activations of the network are the same everywhere"),
        (same_everywhere(torch.nan), "the activations of the network are not finite"),
    ],
)
def test_a_network_without_features_is_refused_in_one_line(network, message):
    segmenter = Segmenter(network, SPACE, PLAIN)
    assert segmenter.problem_of_features.startswith(f"the network: {message}")
    refuses(f"^the network: {message}", segmenter.segment, PHOTOS[:1], features=True)


# ---- which activations are features, and taking them


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
