"""What is heavy is imported only where it is used. Who may import whom: see pyproject.toml."""

import importlib
import sys
from functools import cache
from pathlib import Path

import pytest
from helpers import outcome


@cache
def printed(program, *arguments):
    """What a program prints in a process of its own, without an error or a note."""
    code, out, errors = outcome(sys.executable, "-c", program, *arguments)
    assert (code, errors) == (0, [])
    return "\n".join(out)


LIGHT = """
import sys, ssrvlad_torch
from ssrvlad_torch import SSRVLADConfig, LabelSpace
from ssrvlad_torch.taxonomy import label_space
label_space(SSRVLADConfig().labels_as).digest
assert "torch" not in sys.modules
from ssrvlad_torch.baselines import make
make("label-grid")
name = "ssrvlad_torch.baselines"
print(*sorted(m.removeprefix(name) for m in sys.modules if m.startswith(name)))
import ssrvlad_torch.cli.main, ssrvlad_torch.cli.demo, ssrvlad_torch.files
heavy = "skimage scipy matplotlib kornia onnx onnxscript onnxruntime"
assert not {*heavy.split()} & {*sys.modules}
"""


def test_heavy_packages_are_imported_only_where_they_are_used():
    """Settings, label spaces and names need no torch, the package none of its extras, and of the
    methods only that is imported which is made."""
    assert printed(LIGHT).split() == [".channel_methods", ".protocol"]


WITHOUT = """
import sys
sys.modules |= dict.fromkeys(("skimage", "matplotlib", "onnx", "onnxscript"))
import numpy as np, torch
with torch.device("meta"):
    from ssrvlad_torch import SSRVLAD, match
print(match(torch.eye(30)[:3], torch.eye(30), top=1).indices.flatten().tolist())
def reference(): import ssrvlad_torch.reference
def show(): SSRVLAD().explain(np.zeros((1, 9, 9), int)).show()
def graph(): from ssrvlad_torch.deployment.export import head_model; head_model(SSRVLAD().config)
def fused():
    from ssrvlad_torch.deployment.fuse import fuse
    from ssrvlad_torch.segmentation.segmenter import Segmenter
    fuse(Segmenter(torch.nn.Conv2d(3, 19, 1), SSRVLAD().label_space), SSRVLAD().config, "f.onnx")
for given in (reference, show, graph, fused):
    try: given()
    except ImportError as error: print(error)
"""


def test_no_tensor_stays_on_the_device_of_an_import():
    assert printed(WITHOUT).startswith("[0, 1, 2]\n")


def test_a_missing_extra_is_named():
    out = printed(WITHOUT)
    assert out.count("pip install ssrvlad-torch[eval]") == 2
    assert out.count("pip install ssrvlad-torch[onnx]") == 2


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
    assert "Example: ssrvlad encode" in printed(ELSEWHERE, "encode", "--help")


SCRIPTS = Path(__file__).parents[1] / "scripts" / "pages"


@pytest.mark.parametrize("script", sorted(path.stem for path in SCRIPTS.glob("*.py")))
def test_every_script_of_pages_can_be_imported(script):
    """Most of their tests are slow ones."""
    importlib.import_module(script)
