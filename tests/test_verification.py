"""Damage: every flipped bit is found and placed, and reading on takes what is whole."""

import random

import pyarrow.parquet as pq
import pytest
import torch
from helpers import descriptors, flip_byte, record

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.storage import parts
from ssrvlad_torch.database.storage.verification import verify

CONFIG = SSRVLADConfig.from_preset("paper", rings=1, sectors=2, labels_as="camvid-11")
PART = "part-000001.parquet"


@pytest.fixture
def path(tmp_path, monkeypatch):
    """Two parts of three row groups of four frames."""
    monkeypatch.setattr(parts, "ROWS_OF_A_GROUP", 4)
    database = Database.create(tmp_path / "db", CONFIG)
    for number in range(2):
        records = [record(f"{number}/{n}") for n in range(12)]
        database.append(records, descriptors(number, 12, CONFIG.length))
    return tmp_path / "db"


def inside_of(path, group, column="descriptor.list.element"):
    """A place in the middle of a row group's pages."""
    meta = pq.ParquetFile(path / PART).metadata.row_group(group)
    for number in range(meta.num_columns):
        chunk = meta.column(number)
        if chunk.path_in_schema == column:
            return chunk.data_page_offset + chunk.total_compressed_size // 2
    raise AssertionError(column)


def test_a_whole_database_has_no_damage(path):
    told = []
    assert verify(path, told.append) == []
    assert sum(told) == 24


@pytest.mark.parametrize("group", [0, 1, 2])
@pytest.mark.parametrize("column", ["descriptor.list.element", "name", "digest"])
def test_the_row_group_of_a_flipped_bit_is_named(path, group, column):
    flip_byte(path / PART, inside_of(path, group, column), 1)
    [damage] = verify(path)
    assert (damage.file, damage.row_group) == (PART, group)
    assert "\n" not in damage.reason


def test_any_flipped_bit_of_a_part_is_found(path):
    whole = (path / PART).read_bytes()
    generator = random.Random(0)
    for _ in range(150):
        flip_byte(path / PART, generator.randrange(len(whole)), 1 << generator.randrange(8))
        assert {damage.file for damage in verify(path)} == {PART}
        with pytest.raises(ValueError, match=PART):
            Database.open(path).load()
        (path / PART).write_bytes(whole)
    assert verify(path) == []


def test_any_flipped_bit_of_the_manifest_is_found(path):
    """But for white space, and letters in which JSON writes no other thing."""
    manifest = path / "manifest.json"
    whole = manifest.read_bytes()
    for place, byte in enumerate(whole):
        if not chr(byte).isspace():
            flip_byte(manifest, place, 1)
            assert [damage.file for damage in verify(path)][:1] == ["manifest.json"], place
            with pytest.raises(ValueError, match="db"):
                Database.open(path)
            manifest.write_bytes(whole)


def test_reading_on_takes_what_is_whole_only_if_told_to(path):
    raw = Database.open(path).load()
    flip_byte(path / PART, inside_of(path, 1), 1)
    with pytest.raises(ValueError, match=PART):
        Database.open(path).load()
    opened = Database.open(path, skip_damaged=True)
    frames = opened.load()
    left = [row for row, frame in enumerate(raw.frames) if frame not in LOST]
    assert frames.frames == tuple(raw.frames[row] for row in left)
    assert torch.equal(frames.descriptors, raw.descriptors[left])
    assert [(damage.file, damage.row_group) for damage in opened.damage] == [(PART, 1)]
    with pytest.raises(ValueError, match="is damaged: wanted what is lost dropped"):
        opened.append([record("x/1")], descriptors(0, 1, CONFIG.length))


LOST = {"1/4", "1/5", "1/6", "1/7"}


def test_what_is_lost_can_be_dropped_and_encoded_again(path):
    flip_byte(path / PART, inside_of(path, 1), 1)
    opened = Database.open(path, skip_damaged=True)
    assert [damage.row_group for damage in opened.drop_damaged()] == [1]
    assert verify(path) == []
    assert len(Database.open(path)) == 20
    assert set(Database.open(path).digests()).isdisjoint(LOST)
    opened.append([record(frame) for frame in sorted(LOST)], descriptors(5, 4, CONFIG.length))
    assert len(Database.open(path)) == 24


@pytest.mark.parametrize("spoil", [lambda part: part.unlink(), lambda part: part.write_bytes(b"")])
def test_a_part_that_is_gone_is_damage_as_a_whole(path, spoil):
    spoil(path / PART)
    [damage] = verify(path)
    assert (damage.file, damage.row_group) == (PART, None)
    assert len(Database.open(path, skip_damaged=True).load().frames) == 12
    Database.open(path, skip_damaged=True).drop_damaged()
    assert verify(path) == []
    assert len(Database.open(path)) == 12


def test_a_damaged_manifest_that_makes_sense_is_followed_if_told_to(path):
    manifest = path / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"checksum": "', '"checksum": "0'))
    with pytest.raises(ValueError, match="its checksum does not fit"):
        Database.open(path)
    assert len(Database.open(path, skip_damaged=True).load().frames) == 24
    Database.open(path, skip_damaged=True).drop_damaged()
    assert len(Database.open(path).load().frames) == 24


def test_what_is_no_database_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a database"):
        verify(tmp_path)
