"""What is heavy is imported only where it is used. Who may import whom: see pyproject.toml."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest


def test_the_package_loads_without_the_extras():
    """Core stays light: neither scikit-image, scipy, matplotlib nor kornia comes with an import."""
    heavy = (
        "skimage",
        "scipy",
        "matplotlib",
        "kornia",
        "onnx",
        "onnxscript",
        "onnxruntime",
        "sklearn",
    )
    code = (
        "import sys, ssrvlad_torch.cli.main, ssrvlad_torch.cli.demo, ssrvlad_torch.picture;"
        f"print([m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


WITHOUT = """
import sys
sys.modules["skimage"] = sys.modules["matplotlib"] = None
import numpy as np
from ssrvlad_torch import SSRVLAD
def reference(): import ssrvlad_torch.reference
def show(): SSRVLAD().explain(np.zeros((1, 9, 9), int)).show()
for given in (reference, show):
    try: given()
    except ImportError as error: print(error)
"""


def test_a_missing_extra_is_named():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT], capture_output=True, text=True, check=True
    )
    assert done.stdout.count("pip install ssrvlad-torch[eval]") == 2


ELSEWHERE = """
import os, sys
sys.modules |= dict.fromkeys(("fcntl", "resource", "termios", "pwd", "grp"))
for name in ("fork", "getuid", "killpg", "posix_fallocate", "sched_getaffinity"):
    delattr(os, name)
import ssrvlad_torch
from ssrvlad_torch.cli.main import main
[getattr(ssrvlad_torch, name) for name in ssrvlad_torch.__all__]
main()
"""


def test_every_public_name_and_help_do_without_what_windows_lacks():
    command = [sys.executable, "-c", ELSEWHERE, "encode", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "Example: ssrvlad encode" in done.stdout


SCRIPTS = Path(__file__).parents[1] / "scripts" / "pages"


@pytest.mark.parametrize("script", sorted(path.stem for path in SCRIPTS.glob("*.py")))
def test_what_the_scripts_of_pages_import_is_there(script):
    """Most of their tests are slow ones."""
    importlib.import_module(script)


def test_settings_label_spaces_and_names_need_no_torch():
    code = (
        "import sys, ssrvlad_torch; from ssrvlad_torch import SSRVLADConfig, LabelSpace;"
        "from ssrvlad_torch.taxonomy import label_space;"
        "label_space(SSRVLADConfig().labels_as).digest; print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
