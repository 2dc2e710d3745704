"""Randomly damaged files for every reader; `scripts/fuzz` tries many more."""

import random

import pytest
from random_damage import READERS, REFUSALS, damaged


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.filterwarnings("ignore")
def test_it_is_read_or_refused(reader, tmp_path):
    good, suffix, read = READERS[reader](tmp_path)
    source, refused = random.Random(0), 0
    for _ in range(60):
        given = tmp_path / f"given{suffix}"
        given.write_bytes(damaged(source, good))
        try:
            read(given)
        except REFUSALS as error:
            refused += 1
            assert str(error)
    assert refused > 0
