"""A file of fixed size, converted by onnx2tf, in LiteRT. Both want other versions of libraries than
this package: ``SSRVLAD_LITERT`` names a Python that has them (onnx2tf, ai-edge-litert)."""

import os
import subprocess

import numpy as np
import pytest
from drawings import SPACE, blobs

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head
from ssrvlad_torch.deployment.golden import outputs_of

PYTHON = os.environ.get("SSRVLAD_LITERT")
SIZE = (131, 170)

RUN = """
import sys
import numpy as np
from ai_edge_litert.interpreter import Interpreter
model = Interpreter(sys.argv[1], num_threads=1)
model.allocate_tensors()
(given,), outputs = model.get_input_details(), model.get_output_details()
found = {}
for labels in np.load(sys.argv[2]):
    model.set_tensor(given["index"], labels[None])
    model.invoke()
    for output in outputs:
        name = "descriptor" if len(output["shape"]) == 2 else "unknown"
        found.setdefault(name, []).append(model.get_tensor(output["index"])[0])
np.savez(sys.argv[3], **found)
"""


@pytest.mark.skipif(not PYTHON, reason="SSRVLAD_LITERT names no Python with onnx2tf and LiteRT")
def test_litert_gives_the_descriptors_of_the_module(tmp_path):
    config = SSRVLADConfig.from_preset("default", labels_as=SPACE)
    export_head(config, tmp_path / "head.onnx", shape=(1, *SIZE))
    convert = [PYTHON, *["-m", "onnx2tf", "-kat", "labels", "-n", "-i"], tmp_path / "head.onnx"]
    subprocess.run([*convert, "-o", tmp_path], check=True, capture_output=True)
    maps = np.stack([blobs(seed, *SIZE, 4 + 3 * seed) for seed in range(6)])
    maps = np.append(maps, np.random.default_rng(0).integers(0, 15, (3, *SIZE), np.uint8), axis=0)
    np.save(tmp_path / "maps.npy", maps)
    files = (tmp_path / name for name in ("head_float32.tflite", "maps.npy", "found.npz"))
    subprocess.run([PYTHON, "-c", RUN, *files], check=True, capture_output=True)
    expected = outputs_of(SSRVLAD(config), maps)
    with np.load(tmp_path / "found.npz") as found:
        np.testing.assert_array_equal(found["unknown"], expected["unknown"])
        np.testing.assert_allclose(found["descriptor"], expected["descriptor"], rtol=0, atol=1e-6)
