"""The C++ library and its program against the reference; needs a C++ compiler only."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from drives import write_maps
from PIL import Image

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.taxonomy import label_space

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "export" / "cpp" / "describe"
CORE = ROOT / "ssrvlad_torch" / "native"
SPACE = "camvid-11"


@pytest.fixture(scope="module")
def describe(core, tmp_path_factory):
    """The program, compiled; the library, which takes longer, is that of the package."""
    program, library = tmp_path_factory.mktemp("build") / "describe", Path(core.library._name)
    flags = ["-std=c++17", "-O0", "-pthread", "-Wall", "-Wextra", "-Werror", f"-I{CORE}"]
    given = [SOURCE / "describe.cpp", library, f"-Wl,-rpath,{library.parent}"]
    subprocess.run(["g++", *flags, *given, "-o", program], check=True)

    def run(*arguments):
        command = [program, *map(str, arguments)]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        return ran.returncode, ran.stdout.splitlines(), ran.stderr.splitlines()

    return run


@pytest.fixture
def inputs(tmp_path):
    """The categories of CamVid's ids, and a label map."""
    categories = np.full(256, 255, np.uint8)
    for label in label_space(SPACE).classes:
        categories[label.id] = label.category_index
    np.save(tmp_path / "categories.npy", categories)
    file = next(iter(sorted(write_maps(tmp_path / "maps", range(1)).iterdir())))
    np.save(tmp_path / "map.npy", np.asarray(Image.open(file)))
    return tmp_path / "categories.npy", tmp_path / "map.npy"


@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
@pytest.mark.parametrize("preset", PRESETS)
def test_its_numbers_are_those_of_the_reference(describe, inputs, preset, dtype):
    labels = np.load(inputs[1])
    np.save(inputs[1], labels.astype(dtype))
    code, lines, errors = describe(preset, *inputs)
    assert (code, errors) == (0, [])
    config = SSRVLADConfig.from_preset(preset, labels_as=SPACE)
    expected = reference.describe(labels, config)
    np.testing.assert_allclose([float(line) for line in lines], expected, rtol=0, atol=1e-6)


def test_wrong_use_is_one_line(describe, inputs, tmp_path):
    categories, labels = inputs
    np.save(tmp_path / "strange.npy", np.full((4, 5), 77, np.uint8))
    np.save(tmp_path / "real.npy", np.zeros((4, 5)))
    for arguments, message in [
        (("default", categories), "usage"),
        (("best", categories, labels), "expected the preset default or paper, got best"),
        (("default", labels, labels), "expected (256,) uint8, got 2 axes"),
        (("default", categories, tmp_path / "none.npy"), "cannot be read"),
        (("default", categories, tmp_path / "strange.npy"), "20 pixels have an id without"),
        (("default", categories, tmp_path / "real.npy"), "got 2 axes of <f8"),
    ]:
        code, _, errors = describe(*arguments)
        assert (code, len(errors)) == (2, 1), (arguments, errors)
        assert message in errors[0]


@pytest.mark.skipif(shutil.which("cmake") is None, reason="CMake is not installed")
def test_cmake_takes_it(tmp_path):
    command = ["cmake", "-S", SOURCE, "-B", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
