"""What README.md and the guides quote of the pages is what the pages say; scripts fill pages."""

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


def test_a_script_fills_a_page_and_leaves_the_rest(monkeypatch, tmp_path):
    file = tmp_path / "page.md"
    text = "# P\n\nOn {}.\n\n## A\n\nText:\n\n| a |\n| --- |\n{}\nAfter.\n\n## B\n\n{}\n"
    file.write_text(text.format("one", "| 1 |\n| 2 |\n", "old"))
    page = load("_markdown", monkeypatch).Page("page.md", file)
    page.table("## A\n", ["| a |", "| --- |", "| 3 |"])
    page.section("## B", ["new"])
    page.paragraph("On", "On two.")
    assert file.read_text() == page.text == text.format("two", "| 3 |\n", "new")
    page.section("## C", ["last"])
    assert page.text.endswith("new\n\n## C\n\nlast\n")
    with pytest.raises(ValueError, match="found a heading"):
        page.table("On two.", ["| a |"])
