"""The workflows and scripts with which tests run and releases are made."""

import os
import re
import runpy
import sys
from pathlib import Path

import pytest
import yaml
from helpers import outcome

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
NOTES = ROOT / "scripts" / "notes"


def test_workflows_call_scripts_that_exist():
    called = {
        program
        for file in WORKFLOWS
        for job in yaml.safe_load(file.read_text())["jobs"].values()
        for step in job["steps"]
        for program in re.findall(r"^(?:scripts|\.ci)/\w+", step.get("run", ""), re.MULTILINE)
    }
    known = {".ci/run", "scripts/docs", "scripts/floors", "scripts/notes", "scripts/wheels"}
    assert called == known
    assert all(os.access(ROOT / program, os.X_OK) for program in called)


def test_notes_are_the_section_of_a_version():
    section = runpy.run_path(str(NOTES))["section"]
    text = "# C\n\n## Unreleased\n\n## 1.2.3, 2027-01-31\n\nNew.\n\n### Parts\n- a\n\n## 1.2\nOld\n"
    assert section(text, "v1.2.3") == "New.\n\n### Parts\n- a\n"
    assert section(text, "1.2") == "Old\n"
    for version in ("v1.2.4", "Unreleased"):
        with pytest.raises(ValueError, match=r"expected a section .*, got Unreleased, 1.2.3, 1.2$"):
            section(text, version)


@pytest.mark.parametrize(("ci", "failed"), [("true", 2), ("", 0)])
def test_ci_refuses_skips_that_are_not_allowed(tmp_path, ci, failed):
    (tmp_path / "test_skips.py").write_text(
        "import pytest\n"
        "def test_allowed(): pytest.skip('there is no CUDA device')\n"
        "def test_program(): pytest.skip('npm is not installed')\n"
        "def test_package(): pytest.importorskip('no_such_package')\n"
        "@pytest.mark.xfail\n"
        "def test_known(): assert 0\n"
    )
    environment = {**os.environ, "CI": ci, "PYTHONPATH": str(ROOT / "tests")}
    command = (sys.executable, "-m", "pytest", "-p", "skips", "--rootdir", tmp_path, tmp_path)
    code, out, _ = outcome(*command, env=environment)
    assert code == (1 if failed else 0), out
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (\w+)", out[-1])}
    assert (counts.get("failed", 0), counts["skipped"]) == (failed, 3 - failed)
    assert counts["xfailed"] == 1
    refusal = "skipped, which CI does not allow: Skipped: npm is not installed"
    assert (refusal in "\n".join(out)) == bool(ci)
