"""What README.md and the guides quote of the pages is what the pages say."""

import importlib
import re
from pathlib import Path

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
