"""A hostile file is refused with at most 300 MB of memory."""

import json
import subprocess
import sys
from pathlib import Path

import bad_files as bad
import pytest

PROGRAM = """
import json, pathlib, sys, zlib, base64
from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.datasets.label_files import read_label_map
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.evaluation.ground_truth_files import from_file
from ssrvlad_torch.files import read_npz
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.taxonomy import label_space

def memory(name):
    status = pathlib.Path("/proc/self/status").read_text()
    return int(status.split(name + ":")[1].split()[0]) // 1024

def label_map(path):
    read_label_map(FrameFile("a", "x", path), label_space("camvid-11"))

def golden(path):
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(bytes(1 << 20)) for _ in range(64)) + packer.flush()
    entry = {"dtype": "uint8", "shape": [1 << 20], "data": base64.b64encode(data).decode()}
    Metadata("", {}, "", {}, {}, {"labels": entry}).golden_arrays()

readers = {
    "label map": label_map,
    "picture": lambda path: read_image(FrameFile("a", "x", path)),
    "label space": label_space,
    "ground truth": lambda path: from_file(path, ["a"], ["b"]),
    "archive": read_npz,
    "golden": golden,
    "size": lambda path: SegmenterConfig(size=(30000, 30000)),
}
for reader, path in json.loads(sys.argv[1]):
    pathlib.Path("/proc/self/clear_refs").write_text("5")
    idle, refused = memory("VmRSS"), None
    try:
        readers[reader](pathlib.Path(path))
    except ValueError as error:
        refused = str(error)
    print(json.dumps([reader, path, memory("VmHWM") - idle, refused]), flush=True)
"""


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux's /proc")
def test_refused_files_need_little_memory(tmp_path):
    large, none = "has 13000 x 13000 pixels; expected at most 64000000", "has 0 bytes for an array"
    device, aliases = "is a device; expected a file", "an alias in line 2"
    huge = bad.array(tmp_path / "huge.npy", (1 << 30, 1 << 30, 3))
    files = [
        ("label map", bad.png(tmp_path / "gray.png"), large),
        ("label map", bad.tiff(tmp_path / "gray.tif"), large),
        ("label map", bad.endless(tmp_path / "zero.png"), device),
        ("label map", huge, none),
        ("picture", bad.png(tmp_path / "colour.png", colours=2), large),
        ("picture", tmp_path / "gray.tif", large),
        ("picture", tmp_path / "zero.png", device),
        ("picture", bad.pipe(tmp_path / "pipe.jpg"), "is a pipe; expected a file"),
        ("picture", huge, none),
        ("label space", bad.text(tmp_path / "bomb.yaml", bad.ALIASES), aliases),
        ("label space", bad.endless(tmp_path / "zero.yaml"), device),
        ("archive", bad.archive(tmp_path / "zeros.npz", 300 << 20), "SSRVLAD_FILE_LIMIT"),
        ("ground truth", huge, none),
        ("golden", tmp_path, ""),
        ("size", tmp_path, "SSRVLAD_PIXEL_LIMIT"),
    ]
    table = json.dumps([(reader, str(path)) for reader, path, _ in files])
    command = [sys.executable, "-c", PROGRAM, table]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    for (reader, path, megabytes, refused), (*_, message) in zip(rows, files, strict=True):
        assert refused and message in refused, (reader, path, refused)
        assert megabytes <= 300, (reader, path, megabytes)
