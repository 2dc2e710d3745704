"""Databases that earlier versions wrote, which this one must read. None is ever written anew."""

import json
import math
import shutil
from pathlib import Path

import pytest

from ssrvlad_torch import config
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.storage.verification import verify

FIXTURES = Path(__file__).parent / "fixtures"


@pytest.mark.parametrize("name", ["database-2"])
def test_what_an_earlier_version_wrote_is_read_whole(name, tmp_path, monkeypatch):
    """Descriptors of another revision of the method would be refused, and rightly; here only the
    format counts."""
    monkeypatch.setattr(config, "METHOD_REVISION", 1)
    path = shutil.copytree(FIXTURES / name, tmp_path / name)
    assert verify(path) == []
    wanted = json.loads((FIXTURES / f"{name}.json").read_text(encoding="utf-8"))
    found = Database.open(path).table().to_pylist()
    for row in found:
        for key in ("x", "y", "heading"):
            row[key] = None if math.isnan(row[key]) else row[key]
    assert [
        {key: row[key] for key in old} for row, old in zip(found, wanted, strict=True)
    ] == wanted
    frames = Database.open(path).load(temporal=1)
    assert frames.frames[:3] == ("day/0", "day/1", "day/2")
    assert frames.empty.tolist() == [n == 2 for n in range(9)]
    Database.open(path).remove(["day/0"])
    assert len(Database.open(path)) == 8
