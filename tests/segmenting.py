"""A painted world, photographs of it, and what the tests of segmentation share."""

import json
from pathlib import Path

import numpy as np
import onnx
import torch
from drawings import SPACE
from helpers import street, write_image
from networks import photo, write_graph
from networks import write_street as write_network

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.channels.channel import new_channels
from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.encoding.encoder import encode_to_memory
from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.search.exact import recognise_in
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.taxonomy import label_space

LABELS = [street(seed) for seed in range(5)]
PHOTOS = [photo(labels) for labels in LABELS]
NOISE = np.random.default_rng(0).integers(0, 256, (17, 23, 3), np.uint8)


def assert_right(segmenter, photos=PHOTOS, expected=LABELS):
    for labels, right in zip(segmenter(photos), expected, strict=True):
        np.testing.assert_array_equal(labels, right)
        assert labels.dtype == np.uint8


def write_photos(folder, seeds=range(5), size=(24, 32)):
    for seed in seeds:
        write_image(folder / f"{seed}.png", photo(street(seed, *size)))
    return folder


def write_settings(folder, more=""):
    """``net.onnx``, which labels this world, and ``net.yaml``, its settings."""
    write_graph(folder / "net.onnx")
    path = folder / "net.yaml"
    path.write_text(f"network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n{more}")
    return path


def write_named_network(folder):
    """`write_settings`, of a graph that says what its classes are."""
    settings = write_settings(folder)
    model = onnx.load(folder / "net.onnx")
    names = {label.id: label.name for label in label_space(SPACE).classes}
    onnx.helper.set_model_props(model, {"id2label": json.dumps(names)})
    onnx.save(model, folder / "net.onnx")
    return settings


def counted(network):
    """Counts the images that a network is given, in ``network.images``."""
    network.images = torch.zeros((), dtype=torch.int64)

    def count(module, arguments):
        module.images += len(arguments[0])

    network.register_forward_pre_hook(count)
    return network


def write_drives(folder, monday=range(12), today=range(3, 9), size=(96, 144)):
    """A network with features as ``net.yaml``, photos in ``monday`` and ``today``, and the fused
    files: ``place.onnx``, or ``net.onnx`` and ``head.onnx``."""
    write_network(folder / "seg.onnx")
    settings = "network: seg.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\nlabels_as: camvid-11\n"
    (folder / "net.yaml").write_text(settings)
    write_photos(folder / "monday", monday, (96, 128))
    write_photos(folder / "today", today, size)
    config = SSRVLADConfig(labels_as="camvid-11")
    fuse(folder / "net.yaml", config, folder / "place.onnx")
    fuse(folder / "net.yaml", config, folder / "net.onnx", folder / "head.onnx")
    return folder


def write_moved_drives(ssrvlad, folder, exported):
    """`write_drives`, where the photos of ``today`` are moved by two cells, and ``monday`` as a
    database, also in NumPy's form. Returns the words that query it."""
    write_drives(folder, range(36), (), (96, 128))
    for seed in range(2, 35):
        pixels = np.roll(photo(street(seed, 96, 128)), 14, axis=1)
        write_image(folder / "today" / f"{seed}.png", pixels)
    network = ("--segmenter", folder / "net.yaml")
    database = folder / "town"
    ssrvlad("encode", folder / "monday", "-o", database, *network, "--labels-as", "camvid-11")
    ssrvlad("db", "export", database, "--format", "npy", "-o", exported)
    return ("query", database, folder / "today", *network, "--json")


def write_map(ssrvlad, path, *maps):
    """A database of label maps of cities, also in NumPy's form as ``path``."""
    database = path.with_suffix(".ssrdb")
    assert ssrvlad("encode", *maps, "-o", database, "--labels-as", "cityscapes-trainids")[0] == 0
    assert ssrvlad("db", "export", database, "--format", "npy", "-o", path)[0] == 0
    return database


def write_town(folder, path, top=5):
    """The database of ``monday`` in NumPy's form; the frames and scores of the candidates of the
    photos of ``today``, judged alone by all channels."""
    segmenter = Segmenter.load(folder / "net.yaml")
    head = SSRVLAD(SSRVLADConfig(labels_as="camvid-11"))
    channels = new_channels(None, head, segmenter)
    (today, _), (monday, _) = (
        encode_to_memory(channels, head.label_space, files, 1, segmenter=segmenter)
        for drive in ("today", "monday")
        for files in [find_image_files([str(folder / drive)])]
    )
    ends = ("", ".features.npy", ".hog.npy")
    for end, values in zip(ends, monday.channels.values(), strict=True):
        np.save(f"{path}{end}", values.numpy())
    Path(f"{path}.frames.txt").write_text("".join(f"{frame}\n" for frame in monday.frames))
    for end, channel in zip(ends, channels, strict=True):
        Path(f"{path}{end}.fingerprint.txt").write_text(f"{channel.column.fingerprint}\n")
    steps = Steps(standardise=False, follow=None)
    matches = recognise_in(monday, today, channels, steps, top).matches
    return [
        ([monday.frames[row] for row in rows], scores)
        for scores, rows in zip(matches.scores.tolist(), matches.indices.tolist(), strict=True)
    ]
