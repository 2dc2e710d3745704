"""Damage to a database is found and named, and what is whole stays."""

from pathlib import Path

import pytest
from four_frames import fill, filled, loaded
from helpers import descriptors, flip_byte, refused, spoil

from ssrvlad_torch import Database


@pytest.fixture
def path(tmp_path):
    return filled(tmp_path)


def data_file(path):
    [file] = Path(path).glob("data/*.lance")
    return file


def test_a_changed_byte_of_a_data_file_is_reported_or_has_no_effect(path):
    whole, before = data_file(path).read_bytes(), loaded(path)
    refused, positions = 0, range(0, len(whole), 149)
    for position in positions:
        data_file(path).write_bytes(whole)
        flip_byte(data_file(path), position, 1 << position % 8)
        try:
            assert loaded(path) == before
        except ValueError as error:
            refused += 1
            assert str(path) in str(error)
            assert "\n" not in str(error)
            assert Database.open(path).damage() != []
    assert refused > len(positions) * 0.8
    data_file(path).write_bytes(whole)
    assert loaded(path) == before


def test_a_damaged_descriptor_is_reported_and_dropped(path):
    expected = loaded(path)
    spoil(path, descriptors(0, 4)[3])
    database, file = Database.open(path), f"data/{data_file(path).name}"
    with refused(rf"town\.ssrdb is damaged: {file}: the checksum of frame 'day/9' differs"):
        database.load()
    [damage] = database.damage()
    assert (damage.file, damage.rows) == (file, 1)
    assert [damage] == database.drop_damaged()
    assert database.damage() == Database.open(path).damage() == []
    del expected["day/9"]
    assert loaded(path) == expected
    fill(database, ["day/9"])
    assert len(loaded(path)) == 4


@pytest.mark.parametrize("length", [None, 0, 4, 1000])
def test_a_missing_or_truncated_file_is_reported_and_its_rows_are_dropped(path, length):
    lost = data_file(path)
    fill(Database.open(path), ["other/1"])
    if length is None:
        lost.unlink()
    else:
        lost.write_bytes(lost.read_bytes()[:length])
    with refused("is damaged"):
        Database.open(path).load()
    [damage] = Database.open(path).damage()
    assert (damage.file, damage.rows) == (f"data/{lost.name}", 4)
    Database.open(path).drop_damaged()
    assert list(loaded(path)) == ["other/1"]


def test_a_manifest_that_a_power_cut_left_half_written_is_named(path):
    before = loaded(path)
    fill(Database.open(path), ["lost/1"])
    fill(Database.open(path), ["lost/2"])
    newest = sorted(path.glob("_versions/*.manifest"))[:2]
    for manifest, size in zip(newest, (0, 60), strict=True):
        manifest.write_bytes(manifest.read_bytes()[:size])
    names = ", ".join(f"_versions/{manifest.name}" for manifest in newest)
    message = f"is damaged .*; --as-of 2 reads .*without {names}"
    with refused(message):
        Database.open(path)
    assert loaded(path, version=2) == before
    for manifest in newest:
        manifest.unlink()
    assert loaded(path) == before
    fill(Database.open(path), ["lost/1"])
    assert len(loaded(path)) == len(before) + 1
    assert Database.open(path).damage() == []
