"""The registry of methods, and settings that are refused."""

from importlib import import_module

import pytest

from ssrvlad_torch.baselines import METHODS, make


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_where_the_registry_says(name):
    module, class_name = METHODS[name]
    method = getattr(import_module(f"ssrvlad_torch.baselines.{module}"), class_name)
    for function in ("encode_query", "encode_reference", "scores"):
        assert callable(getattr(method, function))


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("orb", {}, "unknown method 'orb'; expected one of ssr-vlad, feat"),
        ("cohog", {"cell": 3}, "method cohog: got an unexpected keyword argument 'cell'"),
        ("ssr-vlad", {"cell": 3}, "unknown setting 'cell'"),
        ("cohog", {"size": 16}, "method cohog: size must be 32, 48, 64, ..., got 16"),
        ("cohog", {"size": 100}, "method cohog: size must be 32, 48, 64, ..., got 100"),
        ("cohog", {"entropy_threshold": 1.5}, "entropy_threshold must be from 0 to 1, got 1.5"),
        ("tiny-image", {"width": 60}, "multiples of 8, got 60 x 32"),
        ("tiny-image", {"height": 0}, "multiples of 8, got 64 x 0"),
        ("hog", {"rows": 0, "columns": 4}, "hog: the grid must be 1 x 1 or more, got 0 x 4"),
        ("label-grid", {"columns": 0}, "the grid must be 1 x 1 or more, got 6 x 0"),
        ("ssr-vlad", {"temporal": -1}, "temporal must be 0 or more, got -1"),
        ("ssr-vlad", {"preset": "best"}, "preset must be one of paper, default, got 'best'"),
    ],
)
def test_unknown_methods_and_wrong_settings_are_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        make(name, **settings)
