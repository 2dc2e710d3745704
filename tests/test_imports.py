"""Data flows one way, and what is heavy is imported only where it is used."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import ssrvlad_torch

PACKAGE = Path(ssrvlad_torch.__file__).parent

ALLOWED = {
    "config": set(),
    "files": set(),
    "graph": set(),
    "interruption": set(),
    "pipeline": set(),
    "taxonomy": set(),
    "matching": set(),
    "bitplanes": {"graph"},
    "words": {"bitplanes", "graph"},
    "stages": {"bitplanes", "graph", "taxonomy", "words"},
    "descriptor": {"bitplanes", "config", "soft", "stages", "taxonomy"},  # soft only when asked
    "soft_stages": {"taxonomy"},
    "soft": {"bitplanes", "config", "descriptor", "soft_stages", "stages", "taxonomy"},
    "training": set(),
    "reference": {"config", "taxonomy"},
    "skeleton_noise": {"bitplanes", "config", "descriptor", "stages"},
    "storage": {"config", "files"},
    "database": {"config", "matching", "storage"},
    "exporting": {"database", "files"},
    "searching": {"database", "files", "matching"},
    "selecting": {"database"},
    "evaluation": {"database", "files"},
    "datasets": {"database", "files", "taxonomy"},
    "network_outputs": {"datasets", "taxonomy"},
    "onnx_network": {"network_outputs"},
    "segmentation": {"datasets", "files", "network_outputs", "onnx_network", "taxonomy"},
    "encoding": {
        "database",
        "datasets",
        "descriptor",
        "interruption",
        "pipeline",
        "segmentation",
        "taxonomy",
    },
    "ray_engine": {"config", "database", "datasets", "descriptor", "encoding", "storage"},
    "loops": {"config", "files", "matching"},
    "loop_closure": {"database", "datasets", "descriptor", "loops"},
    "loop_stream": {
        "config",
        "database",
        "datasets",
        "descriptor",
        "encoding",
        "evaluation",
        "files",
        "loop_closure",
        "loops",
        "segmentation",
    },
    "trajectory": {"evaluation", "files"},
    "deployment": {
        "__version__",
        "config",
        "datasets",
        "descriptor",
        "files",
        "graph",
        "network_outputs",
        "stages",
        "taxonomy",
        "words",
    },
    "baselines": {
        "config",
        "descriptor",
        "files",
        "matching",
        "onnx_network",
        "stages",
        "taxonomy",
    },
    "show": {"datasets", "descriptor", "files", "taxonomy"},
    "cli": {"commands"},
}
"""Rooms that each room may import from. Those not listed, at the top, may import anything."""


def imported_rooms(file: Path) -> set[str]:
    """Rooms of this package that a file imports from."""
    inside = file.relative_to(PACKAGE).parts
    rooms = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = inside[: len(inside) - node.level]
            path = [*base, *(node.module or "").split(".")] if node.module else [*base]
            rooms |= {path[0]} if path else {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not (node.module or "").startswith("ssrvlad_torch"), f"{file}: import relatively"
    return rooms


@pytest.mark.parametrize("room", ALLOWED)
def test_rooms_import_only_what_lies_below(room):
    files = [PACKAGE / f"{room}.py"] if (PACKAGE / f"{room}.py").exists() else []
    files += (PACKAGE / room).rglob("*.py")
    assert files
    for file in files:
        assert imported_rooms(file) - {room} <= ALLOWED[room], file


def test_only_the_command_line_imports_the_command_line():
    users = {"cli": {"__main__"}, "commands": {"cli", "commands"}}
    for file in PACKAGE.rglob("*.py"):
        room = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for imported in imported_rooms(file) & users.keys():
            assert room in users[imported], file


@pytest.mark.parametrize("room", ["stages", "soft_stages"])
def test_stages_import_no_other_stage(room):
    for file in (PACKAGE / room).glob("*.py"):
        assert room not in imported_rooms(file), file


def test_the_twin_is_imported_only_where_it_is_asked_for():
    code = (
        "import sys, ssrvlad_torch; ssrvlad_torch.SSRVLAD(); before = 'ssrvlad_torch.soft' in "
        "sys.modules; ssrvlad_torch.SSRVLAD(surrogate=True);"
        "print(before, 'ssrvlad_torch.soft' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


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
        "import sys, ssrvlad_torch.cli.main, ssrvlad_torch.cli.demo, ssrvlad_torch.cli.show;"
        f"print([m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("module", ["reference", "show"])
def test_a_missing_extra_is_named(module, tmp_path):
    code = {
        "reference": "import ssrvlad_torch.reference",
        "show": "import numpy as np, pathlib; from ssrvlad_torch import SSRVLAD, show;"
        "show.draw(np.zeros((9, 9), int), SSRVLAD(), pathlib.Path('x.png'), '')",
    }[module]
    blocked = "import sys; sys.modules['skimage'] = sys.modules['matplotlib'] = None;"
    done = subprocess.run(
        [sys.executable, "-c", blocked + code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert "pip install ssrvlad-torch[eval]" in done.stderr
    assert not (tmp_path / "x.png").exists()
