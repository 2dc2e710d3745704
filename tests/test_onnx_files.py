"""ONNX files: whole, damaged, with weights beside them."""

import sys

import pytest
from drawings import SPACE
from helpers import refused
from networks import PLAIN, write_graph

from ssrvlad_torch.segmentation.onnx_files import external_files
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter


@pytest.mark.parametrize("damage", ["text", "truncated", "weights gone", "missing"])
def test_a_damaged_graph_is_an_error_in_one_line(tmp_path, damage, capfd):
    path = write_graph(tmp_path / "net.onnx", external=damage == "weights gone")
    whole = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "weights gone":
        (tmp_path / "net.data").unlink()
    else:
        path.write_bytes({"text": b"hello", "truncated": whole[:-40]}[damage])
    with refused(r"net\.onnx (does not exist|cannot run)"):
        OnnxNetwork(path)
    assert capfd.readouterr() == ("", ""), "the runtime keeps its log to itself"


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    path = write_graph(tmp_path / "net.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install ssrvlad-torch\[onnx\]"):
        Segmenter.load(path, SPACE)


@pytest.mark.parametrize("external", [False, True])
def test_a_graph_is_known_by_its_file_and_its_weights(tmp_path, external):
    def key(white):
        path = write_graph(tmp_path / "net.onnx", external=external, white=white)
        return Segmenter(OnnxNetwork(path), SPACE, PLAIN).key()

    first, second, third = key(1.0), key(1.5), key(1.0)
    assert first == third != second
    assert external_files(tmp_path / "net.onnx") == [tmp_path / "net.data"] * external
