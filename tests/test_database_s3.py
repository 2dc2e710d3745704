"""A database in an object store, tried against a local server that speaks S3."""

import pytest
import torch
from helpers import descriptors

from ssrvlad_torch import Database


def test_a_database_lives_in_a_bucket(bucket):
    uri = f"{bucket}/morning.ssrdb"
    assert not Database.exists(uri)
    database, numbers = Database.create(uri, width=8), descriptors(0, 3, 8)
    database.append(["a/1", "a/2", "a/3"], numbers)
    database.merge(["a/1"], torch.zeros(1, 8))
    database.remove(["a/2"])
    with pytest.raises(ValueError, match=r"frame 'a/1' is in s3://town/morning\.ssrdb already"):
        database.append(["a/1"], numbers[:1])
    opened = Database.open(uri)
    assert Database.exists(uri)
    assert opened.damage() == []
    assert opened.load().frames == ("a/1", "a/3")
    assert torch.equal(opened.load().descriptors[1], numbers[2])
    assert [entry.frames for entry in opened.history()] == [0, 3, 3, 2]
    opened.compact(keep_days=0)
    assert len(Database.open(uri)) == 2
