"""What docs/ tells a user to type, typed: commands of ssrvlad and Python, page by page; figures
that pages quote, the tutorial, and the examples of docstrings."""

import dataclasses
import doctest
import re
from importlib import import_module
from pathlib import Path

import nbformat
import pytest
import tutorial
import yaml
from test_readme import blocks, maps, photos, run, town  # noqa: F401 - fixtures

from ssrvlad_torch.segmentation.preparation import SegmenterConfig

ROOT = Path(__file__).parents[1]
FOLDERS = ("guides", "concepts", "reference", "evaluation", "research")
PAGES = [ROOT / "docs" / "index.md"]
PAGES += [page for name in FOLDERS for page in sorted((ROOT / "docs" / name).glob("*.md"))]
TYPED = [page for page in PAGES if page.parent.name not in ("evaluation", "research")]
OTHER_PROGRAMS = ("scripts/", "pip ", "cmake ", "python ")


@pytest.mark.parametrize("page", TYPED, ids=lambda page: page.stem)
def test_every_command_and_every_snippet_runs(page, run, photos, town, monkeypatch):  # noqa: F811
    lines = [line for block in blocks(page, "console") for line in block.splitlines()]
    commands = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    for command in commands:
        if not command.startswith(OTHER_PROGRAMS):
            assert run(command.replace("--frames 430", "--frames 60")), command
    monkeypatch.chdir(photos)
    python = "\n".join(blocks(page, "python"))
    if "export_head(" in python:  # for a class list and scores of which other tests trace the head
        python = re.sub(r"\b([03]), 19", r"\1, 11", python).replace(
            "cityscapes-trainids", "camvid-11"
        )
    exec(python, {})


def test_the_pages_name_files_that_are_there():
    others = ("CONTRIBUTING.md", "SECURITY.md", "README.md", "export/README.md")
    for page in (*PAGES, *(ROOT / name for name in others)):
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text("utf-8")):
            assert (page.parent / target).exists(), (page.name, target)


def test_the_page_of_cpp_says_where_the_headers_of_onnx_runtime_come_from():
    """From the package that the tests take, among others."""
    page = (ROOT / "export" / "README.md").read_text("utf-8")
    (package,) = re.findall(r"apt download (\S+)", (ROOT / ".ci" / "onnxruntime").read_text())
    assert f"`{package}`" in page and "](../.ci/onnxruntime)" in page


def test_the_page_of_networks_has_every_setting():
    page = ROOT / "docs" / "reference" / "networks.md"
    keys = {
        key
        for row in re.findall(r"^\| (`.*?) \|", page.read_text("utf-8"), re.M)
        for key in re.findall(r"`(\w+)`", row)
    }
    settings = {each.name for each in dataclasses.fields(SegmenterConfig)}
    assert keys == settings | {"network", "labels_as", "arguments", "runtime", "accept_defaults"}
    (example,) = blocks(page, "yaml")
    document = yaml.safe_load(example)
    assert document.keys() <= keys
    given = {k: tuple(v) if isinstance(v, list) else v for k, v in document.items()}
    SegmenterConfig(**{key: given[key] for key in given.keys() & settings})


@pytest.mark.parametrize(
    ("script", "file"), [("fusion", "README.md"), ("loops", "docs/guides/loops.md")]
)
def test_quoted_figures_are_those_of_the_table(script, file):
    text = (ROOT / file).read_text(encoding="utf-8")
    [quoted] = re.findall(f"<!-- {script} -->(.*?)<!-- /{script} -->", text, re.S)
    assert quoted == import_module(script).excerpt()
    assert len(re.findall(r"\b0\.\d\d", quoted)) >= 4


MODULES = (
    "database.database",
    "descriptor",
    "loops.detector",
    "native.map",
    "recognition.matching",
    "recognition.recognise",
    "segmentation.preparation",
    "segmentation.segmenter",
    "soft.descriptor",
    "stages.features",
)


@pytest.mark.parametrize("module", MODULES)
def test_the_example_of_a_docstring_runs_by_itself(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = doctest.DocTestFinder().find(import_module(f"ssrvlad_torch.{module}"), globs={})
    results = [doctest.DocTestRunner().run(each) for each in found if each.examples]
    assert results and not any(result.failed for result in results)


def outputs_of(notebook):
    """What the cells print, their tables, and which of them give pictures."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    texts = [output.text for output in outputs if output.output_type == "stream"]
    tables = [output.data.get("text/html", "") for output in outputs if "data" in output]
    pictures = [any("png" in str(form) for form in output.get("data", {})) for output in outputs]
    return texts, [text for text in tables if "<table>" in text], pictures


def test_the_notebook_gives_the_outputs_that_it_keeps():
    kept = nbformat.read(tutorial.NOTEBOOK, as_version=4)
    texts, tables, pictures = outputs_of(kept)
    assert (len(texts), len(tables), sum(pictures)) == (5, 2, 3)
    assert outputs_of(tutorial.executed()) == (texts, tables, pictures)
