"""What README.md and the guides quote of the pages is what the pages say; the table of runtimes."""

import importlib
import re
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("script", "file"),
    [("results", "README.md"), ("fusion", "README.md"), ("loops", "docs/guides/robot.md")],
)
def test_quoted_figures_are_those_of_the_page(script, file):
    text = (ROOT / file).read_text(encoding="utf-8")
    [quoted] = re.findall(f"<!-- {script} -->(.*?)<!-- /{script} -->", text, re.S)
    page = (ROOT / "docs" / f"{script}.md").read_text(encoding="utf-8")
    assert quoted == importlib.import_module(script).excerpt(page)
    assert len(re.findall(r"\b0\.\d\d", quoted)) >= 4


def test_a_head_that_cannot_be_exported_is_a_row_of_each_runtime(monkeypatch):
    runtimes = importlib.import_module("runtimes")
    maps = [np.zeros((9, 9), np.uint8)]
    monkeypatch.setattr(runtimes, "hundreds_of_label_maps", lambda: {"cityscapes-trainids": maps})
    monkeypatch.setattr(runtimes, "export_head", Mock(side_effect=RuntimeError("no operator")))
    rows = list(runtimes.table(["one", "old/python:two"], ["default"]))[2:]
    for name, cells in zip(["one", "two"], rows, strict=True):
        assert cells.startswith(f"| {name} | default | cannot run: no operator |")
