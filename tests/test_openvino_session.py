"""OpenVINO in the place of a session of ONNX Runtime."""

import pytest
from drawings import SPACE
from helpers import refuses
from networks import PLAIN, assert_right, write_graph, write_settings
from test_segmentation import GRAPHS

from ssrvlad_torch.segmentation import onnx_network
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_files import OpenVinoSession
from ssrvlad_torch.segmentation.onnx_network import OPENVINO, OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter

pytest.importorskip("openvino", reason="the extra openvino is not installed")

FORMS = ("dynamic", "a batch of three", "external weights", "channels last, labels inside")


@pytest.mark.parametrize("form", FORMS)
def test_a_graph_gives_what_the_network_gives(tmp_path, form):
    path = write_graph(tmp_path / "net.onnx", **GRAPHS[form])
    assert_right(Segmenter(OnnxNetwork(path, OPENVINO), SPACE, PLAIN))


def test_a_yaml_file_names_the_runtime_and_the_identity_stays(tmp_path):
    settings = write_settings(tmp_path).read_text()
    (tmp_path / "fast.yaml").write_text(settings + "runtime: openvino\n")
    plain, fast = (Segmenter.load(tmp_path / f"{name}.yaml", SPACE) for name in ("net", "fast"))
    assert (plain.network.runtime, fast.network.runtime) == onnx_network.RUNTIMES
    assert_right(fast)
    assert fast.key() == plain.key()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("net.onnx\nruntime: tensorrt", "must be onnxruntime or openvino, got .te"),
        ("networks:Street\nruntime: openvino", "is for ONNX files, got network: networks:Str"),
    ],
)
def test_a_runtime_that_cannot_be_taken_is_named(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    write_graph(tmp_path / "net.onnx")
    (tmp_path / "fast.yaml").write_text(f"network: {text}")
    refuses(rf"^fast\.yaml: runtime.*{message}", open_network, "fast.yaml")


def test_what_openvino_cannot_run_is_named(tmp_path):
    path = write_graph(tmp_path / "net.onnx")
    refuses(r"^net cannot run in OpenVINO: .*no_such", OpenVinoSession, path, "net", ["no_such"])
    refuses(r"^net cannot run in OpenVINO: ", OpenVinoSession, b"no graph", "net")
