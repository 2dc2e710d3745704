"""Randomly damaged files for every reader; `scripts/fuzz` tries many more."""

import random

import pytest
from random_damage import READERS, damaged, is_refused


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_is_read_or_refused(reader, tmp_path):
    good, suffix, read = READERS[reader](tmp_path)
    source, path = random.Random(0), tmp_path / f"given{suffix}"
    assert sum(is_refused(read, path, damaged(source, good)) for _ in range(30)) > 0
