"""The C++ example against the module; needs CMake and the headers of ONNX Runtime."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from drives import write_maps
from PIL import Image

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head, match

SOURCE = Path(__file__).parents[1] / "export" / "cpp"
CONFIG = SSRVLADConfig(labels_as="camvid-11")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """The program, compiled."""
    if not shutil.which("cmake"):
        pytest.skip("CMake is not installed")
    build = tmp_path_factory.mktemp("build")
    configured = subprocess.run(
        ["cmake", "-S", SOURCE, "-B", build, "-DCMAKE_CXX_FLAGS=-Wall -Wextra -Werror"],
        capture_output=True,
        text=True,
        check=False,
    )
    if configured.returncode:
        assert "ORT_ROOT" not in os.environ, configured.stderr
        assert "onnxruntime" in configured.stderr, configured.stderr
        pytest.skip(
            "the C++ headers of ONNX Runtime are not installed; ORT_ROOT names their folder"
        )
    subprocess.run(["cmake", "--build", build], check=True, capture_output=True)

    def run(*arguments):
        command = [build / "place", *map(str, arguments)]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        return ran.returncode, ran.stdout.splitlines(), ran.stderr.splitlines()

    return run


@pytest.fixture
def town(tmp_path):
    """A head, six label maps as arrays, their descriptors as a database."""
    export_head(CONFIG, tmp_path / "head.onnx")
    files = sorted(write_maps(tmp_path / "maps", range(6)).iterdir())
    labels = np.stack([np.asarray(Image.open(file)) for file in files])
    view = SSRVLAD(CONFIG).explain(torch.from_numpy(labels))
    np.save(tmp_path / "town.npy", view.descriptor.numpy())
    (tmp_path / "town.npy.frames.txt").write_text("".join(f"maps/{n}\n" for n in range(6)))
    (tmp_path / "town.npy.fingerprint.txt").write_text(CONFIG.fingerprint)
    np.save(tmp_path / "map.npy", labels[2])
    Image.fromarray(labels[2]).save(tmp_path / "map.pgm")
    return view


@pytest.mark.parametrize("name", ["map.npy", "map.pgm"])
def test_it_prints_what_the_module_finds(place, town, tmp_path, name):
    code, lines, errors = place(tmp_path / "head.onnx", tmp_path / name, tmp_path / "town.npy", 4)
    assert (code, errors) == (0, [])
    assert lines[0] == "descriptor: 480 numbers, norm 1.000000"
    counts = town.keypoints[2].sum((1, 2)).tolist()
    assert lines[1].split() == ["keypoints:", *map(str, counts)]
    scores, rows = (part[0].tolist() for part in match(town.descriptor[2:3], town.descriptor, 4))
    assert [line.split()[0] for line in lines[2:]] == [f"maps/{row}" for row in rows]
    found = [float(line.split()[1]) for line in lines[2:]]
    assert found == pytest.approx(scores, abs=1e-5)


def test_wrong_use_is_one_line(place, town, tmp_path):
    head, labels, base = (tmp_path / n for n in ("head.onnx", "map.npy", "town.npy"))
    np.save(tmp_path / "strange.npy", np.full((4, 5), 77, np.uint8))
    np.save(tmp_path / "wide.npy", np.zeros((4, 5), np.int64))
    (tmp_path / "cut.npy").write_bytes(labels.read_bytes()[:-1])
    for arguments, message in [
        ((head,), "usage"),
        ((tmp_path / "none.onnx", labels), "none.onnx"),
        ((head, tmp_path / "none.npy"), "cannot be read"),
        ((head, base), "expected an (H, W) map"),
        ((head, tmp_path / "cut.npy"), "the length does not fit"),
        ((head, tmp_path / "strange.npy"), "20 pixels have an id outside"),
        ((head, tmp_path / "wide.npy"), "takes uint8 labels, got <i8"),
        ((head, labels, labels), "expected (R, 480) float32"),
        ((head, labels, base, "many"), "TOP"),
    ]:
        code, _, errors = place(*arguments)
        assert (code, len(errors)) == (2, 1), (arguments, errors)
        assert message in errors[0]
    (tmp_path / "town.npy.fingerprint.txt").write_text("0123456789abcdef")
    assert "do not compare" in place(head, labels, base)[2][0]
