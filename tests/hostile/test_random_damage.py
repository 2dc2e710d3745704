"""Random damage at every door, a little of it; `scripts/fuzz` does it for hours."""

import random

import pytest
from random_damage import DOORS, REFUSALS, damaged


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.filterwarnings("ignore")
def test_it_is_read_or_refused(door, tmp_path):
    good, suffix, read = DOORS[door](tmp_path)
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
