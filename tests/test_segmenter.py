"""From images to descriptors."""

import dataclasses

import numpy as np
import pytest
import torch
import yaml
from drawings import SIGN, SKY, SPACE
from helpers import street
from kornia.enhance import Denormalize, Normalize
from kornia.geometry import Resize
from networks import PLAIN, Then, colour_network, photo, write_graph
from segmenting import LABELS, PHOTOS, write_image, write_photos
from torch import nn

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import check_segmenter, encode_to_memory
from ssrvlad_torch.segmentation import segmenter as segmentation
from ssrvlad_torch.segmentation.segmenter import Segmenter


def test_kornia_a_network_and_the_head_compose():
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    whole = nn.Sequential(Resize((24, 32)), Normalize(0.5, 0.5), Denormalize(0.5, 0.5),
                          colour_network(), head)  # fmt: skip
    images = torch.from_numpy(np.stack(PHOTOS)).permute(0, 3, 1, 2) / 255
    assert torch.equal(whole(images), head(torch.from_numpy(np.stack(LABELS))))


def test_settings_are_keyword_arguments(tmp_path):
    """They are those of a YAML file, by the same names and in the same forms."""
    given = {"size": [24, 32], "mean": [0, 0, 0], "std": [1, 1, 1], "colour_order": "bgr",
             "classes": "0:12"}  # fmt: skip
    segmenter = Segmenter(colour_network(), SPACE, **given)
    write_graph(tmp_path / "net.onnx")
    (tmp_path / "net.yaml").write_text(yaml.safe_dump({"network": "net.onnx", **given}))
    by_file = Segmenter.load(tmp_path / "net.yaml", SPACE)
    assert segmenter.config == dataclasses.replace(by_file.config, output=None)
    assert segmenter.config.classes == (0, 12)
    one = PHOTOS[:1]
    np.testing.assert_array_equal(segmenter(one), by_file(one))
    other = Segmenter(segmenter.network, SPACE, segmenter.config, colour_order="rgb")
    assert other.config == dataclasses.replace(segmenter.config, colour_order="rgb")
    np.testing.assert_array_equal(other(one), LABELS[:1])
    with pytest.raises(ValueError, match="unknown setting 'means'; expected size, longest, mult"):
        Segmenter(colour_network(), SPACE, means=(0, 0, 0))
    with pytest.raises(ValueError, match="mean must be three numbers, got 3"):
        Segmenter(colour_network(), SPACE, mean=3)


def test_progress_moves_while_the_network_works(tmp_path):
    """A frame is reported before the network gets the frame fifty later."""
    files = find_image_files([str(write_photos(tmp_path / "a", range(80)))])
    network, behind, done = colour_network(), [], [0]
    network.register_forward_pre_hook(
        lambda module, given: behind.append(len(behind) - sum(done)) or None
    )
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
        given = [LabelShapes(head)], head.label_space, files, 1, done.append
        encode_to_memory(*given, Segmenter(network, SPACE, PLAIN))
    assert len(behind) == sum(done) == 80
    assert max(behind) <= 50


def test_images_give_the_descriptors_of_their_label_maps(tmp_path):
    """A truncated image and one with unknown ids are skipped, each with a reason."""
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    for seed in range(20):
        labels = street(seed) % SIGN
        labels[2:4, 5:8] = SIGN if seed == 7 else SKY
        write_image(tmp_path / "a" / f"{seed}.png", photo(labels))
        if seed not in (4, 7):
            write_image(tmp_path / "maps" / "a" / f"{seed}.png", labels)
    cut = tmp_path / "a" / "4.png"
    cut.write_bytes(cut.read_bytes()[:60])
    network = Then(lambda scores: scores.argmax(1).masked_fill_(scores.argmax(1) == SIGN, 99))
    segmenter = Segmenter(network, SPACE, PLAIN)
    files = find_image_files([str(tmp_path / "a")])
    channels = [LabelShapes(head)]
    frames, skipped = encode_to_memory(channels, head.label_space, files, segmenter=segmenter)
    maps = find_label_files([str(tmp_path / "maps" / "a")])
    by_maps, _ = encode_to_memory(channels, head.label_space, maps)
    assert frames.frames == by_maps.frames
    assert torch.equal(frames.descriptors, by_maps.descriptors)
    assert [frame.frame for frame in skipped] == ["a/4", "a/7"]
    assert "label id 99 (6 pixels) is not in" in skipped[1].reason
    other = Segmenter(colour_network(), "synthia", PLAIN)
    with pytest.raises(ValueError, match="gives labels of synthia, the head reads camvid-11"):
        check_segmenter(other, head, channels)
