"""The property tests once more, on many random examples."""

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PROPERTIES = [path for path in TESTS.glob("test_*.py") if "\n@given(" in path.read_text()]


@pytest.mark.slow
@pytest.mark.parametrize("path", PROPERTIES, ids=lambda path: path.stem)
def test_property_tests_pass_on_a_thousand_random_examples(path):
    command = [sys.executable, "-m", "pytest", "-q", "--hypothesis-profile=random", path]
    done = subprocess.run(command, cwd=TESTS.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
