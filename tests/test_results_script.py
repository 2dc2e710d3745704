"""What README.md and the guides quote of the pages is what the pages say."""

import re

import pytest

from scripts import SCRIPTS, load

ROOT = SCRIPTS.parents[1]


@pytest.mark.parametrize(
    ("script", "file"),
    [("results", "README.md"), ("fusion", "README.md"), ("loops", "docs/guides/robot.md")],
)
def test_what_is_quoted_is_what_the_page_says(script, file, monkeypatch):
    text = (ROOT / file).read_text(encoding="utf-8")
    [quoted] = re.findall(f"<!-- {script} -->(.*?)<!-- /{script} -->", text, re.S)
    page = (ROOT / "docs" / f"{script}.md").read_text(encoding="utf-8")
    assert quoted == load(script, monkeypatch).excerpt(page)
    assert len(re.findall(r"\b0\.\d\d", quoted)) >= 4


def test_quoting_changes_nothing_else(monkeypatch, tmp_path):
    quote = load("_markdown", monkeypatch).quote
    file = tmp_path / "page.md"
    file.write_text(
        "before <!-- a -->old<!-- /a --> between\n<!-- b -->\nkept\n<!-- /b -->\nafter\n"
    )
    quote(file, "a", "new")
    expected = "before <!-- a -->new<!-- /a --> between\n<!-- b -->\nkept\n<!-- /b -->\nafter\n"
    assert file.read_text() == expected
    with pytest.raises(ValueError, match="<!-- c -->"):
        quote(file, "c", "new")
