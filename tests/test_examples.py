"""Examples in docstrings can be pasted: they import what they use."""

import doctest
from importlib import import_module

import pytest

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
def test_an_example_runs_by_itself(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = doctest.DocTestFinder().find(import_module(f"ssrvlad_torch.{module}"), globs={})
    results = [doctest.DocTestRunner().run(each) for each in found if each.examples]
    assert results and not any(result.failed for result in results)
