"""What `torch.hub` gives."""

from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import SPACE
from helpers import street
from networks import photo, write_graph
from PIL import Image

from ssrvlad_torch import SSRVLAD, Segmenter
from ssrvlad_torch.datasets.image_files import decode_image

ROOT = str(Path(__file__).parents[1])


def test_torch_hub_loads_the_head_alone_and_with_a_network(tmp_path):
    head = torch.hub.load(ROOT, "ssrvlad", source="local", labels_as=SPACE)
    network = write_graph(tmp_path / "net.onnx")
    whole = torch.hub.load(ROOT, "ssrvlad", source="local", segmenter=str(network), labels_as=SPACE)
    picture = photo(street(1, 60, 80))
    labels = Segmenter.load(network, SPACE)([picture])[0]
    found = whole(torch.from_numpy(picture)[None])
    assert torch.equal(found, head(torch.from_numpy(labels)[None]))
    assert isinstance(head, SSRVLAD)


def test_a_small_file_of_many_pixels_is_an_error(tmp_path, monkeypatch):
    Image.new("RGB", (100, 60)).save(tmp_path / "a.png")
    np.save(tmp_path / "b.npy", np.zeros((60, 100, 3), np.uint8))
    monkeypatch.setenv("SSRVLAD_PIXEL_LIMIT", "5999")
    for name in ("a.png", "b.npy"):
        with pytest.raises(ValueError, match="60 x 100 pixels; expected at most 5999"):
            decode_image((tmp_path / name).read_bytes())
