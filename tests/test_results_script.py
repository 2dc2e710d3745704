"""What README.md quotes of the results is what the results say."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def results(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts" / "pages"))
    return pytest.importorskip("results", reason="the scripts are not part of an installed copy")


def test_readme_quotes_the_results(results):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    quoted = readme.partition("<!-- results -->\n")[2].partition("\n<!-- /results -->")[0]
    assert quoted == results.excerpt((ROOT / "docs" / "results.md").read_text(encoding="utf-8"))
    assert "SSR-VLAD, default" in quoted


def test_quoting_changes_nothing_else(results, tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("before\n<!-- results -->\nold\n<!-- /results -->\nafter\n")
    results.quote_in_readme(ROOT / "docs" / "results.md", readme)
    lines = readme.read_text().splitlines()
    assert lines[:2] == ["before", "<!-- results -->"]
    assert lines[-2:] == ["<!-- /results -->", "after"]
    assert "old" not in lines
