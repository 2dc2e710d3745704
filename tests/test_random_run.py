"""The property tests once more, on many random examples."""

import sys
from pathlib import Path

import pytest
from helpers import outcome

TESTS = Path(__file__).parent
PROPERTIES = [path for path in TESTS.rglob("test_*.py") if "\n@given(" in path.read_text()]


@pytest.mark.slow
@pytest.mark.parametrize("path", PROPERTIES, ids=lambda path: path.stem)
def test_property_tests_pass_on_a_thousand_random_examples(path):
    command = (sys.executable, "-m", "pytest", "-q", "--hypothesis-profile=random", path)
    code, out, _ = outcome(*command, cwd=TESTS.parent)
    assert code == 0, "\n".join(out)
