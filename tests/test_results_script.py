"""What README.md and the guides quote of tables is what the tables say."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("script", "file"), [("fusion", "README.md"), ("loops", "docs/guides/loops.md")]
)
def test_quoted_figures_are_those_of_the_table(script, file):
    text = (ROOT / file).read_text(encoding="utf-8")
    [quoted] = re.findall(f"<!-- {script} -->(.*?)<!-- /{script} -->", text, re.S)
    assert quoted == importlib.import_module(script).excerpt()
    assert len(re.findall(r"\b0\.\d\d", quoted)) >= 4
