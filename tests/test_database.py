"""A database on disk: round trips, settings and wrong arguments."""

import math
from pathlib import Path

import lance
import numpy as np
import pyarrow as pa
import pytest
import torch
from helpers import (
    CONFIG,
    FRAMES,
    SORTED,
    descriptors,
    fill,
    filled,
    flip_byte,
    loaded,
    record,
    refused,
    refuses,
    spoil,
)

import ssrvlad_torch.config as config_module
from ssrvlad_torch import Database, Map, SSRVLADConfig
from ssrvlad_torch.taxonomy import label_space

ONE = torch.ones(1, 480)


@pytest.fixture
def path(tmp_path):
    return filled(tmp_path)


def test_stored_frames_are_loaded_bit_for_bit(tmp_path):
    database = Database.create(tmp_path / "db", CONFIG)
    origin = database.add_origin(label_space("camvid-11"), "network 7")
    numbers = descriptors(1, 3)
    numbers[1] = 0
    records = [
        record("a b/ü", x=1.5, y=-2.0, heading=math.pi, stamp=12.25, origin=origin),
        record("c/1", signature="size and time", digest="", height=7, width=9),
        record("sequence/of/several/1"),
    ]
    database.append(records, numbers)
    opened = Database.open(tmp_path / "db")
    frames = opened.load()
    assert frames.frames == ("a b/ü", "c/1", "sequence/of/several/1")
    assert frames.sequences == ("a b", "c", "sequence/of/several")
    assert torch.equal(frames.descriptors, numbers)
    assert frames.descriptors.dtype == torch.float32
    np.testing.assert_array_equal(frames.poses[0], [1.5, -2, math.pi])
    assert np.isnan(frames.poses[1:]).all()
    assert frames.stamps[0] == 12.25
    assert frames.empty.tolist() == [False, True, False]
    known = opened.known()
    assert [repr(known[entry.frame]) for entry in records] == [repr(entry) for entry in records]
    assert opened.origins[origin].label_space == label_space("camvid-11")
    assert opened.config == CONFIG
    assert str(tmp_path / "db") in repr(opened)
    assert "3 frames of 3 sequences" in repr(frames)


def test_custom_descriptors_need_only_ids_and_have_no_settings(tmp_path):
    numbers, names = descriptors(0, 3, 7), ("one", "drive/2", "drive/10")
    Database.create(tmp_path / "db", width=7).append(names, numbers.numpy())
    opened = Database.open(tmp_path / "db")
    assert opened.load().frames == names
    assert torch.equal(opened.load().descriptors, numbers)
    assert (opened.fingerprint, opened.info()["width"], opened.info()["config"]) == ("", 7, None)
    refuses("without settings", opened.require, CONFIG)


def test_frames_are_in_natural_order_however_they_were_added(path, tmp_path):
    assert Database.open(path).load().frames == SORTED
    one_by_one = Database.create(tmp_path / "other", CONFIG)
    for frame in reversed(FRAMES):
        fill(one_by_one, [frame])
    assert one_by_one.load().frames == one_by_one.placed()[0].frames == SORTED


def test_other_settings_are_refused_with_both_fingerprints_and_the_difference(path, monkeypatch):
    other = SSRVLADConfig.from_preset("paper", rings=4)
    for refuse in (Database.open_or_create, lambda path, c: Database.open(path).require(c)):
        message = "working_size 120 there and None here"
        with refused(message, CONFIG.fingerprint, other.fingerprint) as refusal:
            refuse(path, other)
        assert "labels_as" not in str(refusal.value)
    monkeypatch.setitem(config_module.METHOD_REVISIONS, "harmonics", 99)
    refuses("another version of the method", Database.open, path)


REFUSED = {
    r"ssr-vlad: expected \(2, 480\)": [
        (["a/1", "a/2"], torch.zeros(shape))
        for shape in ((1, 480), (3, 480), (2, 479), (2, 1, 480), (960,))
    ],
    "ssr-vlad: expected float32, got ": [
        (["a/1"], np.full((1, 480), value)) for value in (1j, "1")
    ],
    "not finite": [(["a/1"], ONE * math.nan), (["a/1"], ONE * math.inf)],
    "too large or too small for a length": [(["a/1"], ONE * 3e38), (["a/1"], ONE * 1e-30)],
    "expected a frame id, <sequence>/<name> or <name>, got ": [
        ([frame], ONE) for frame in ("", " ", "a/", "/1", " a/1", "a/1\n")
    ],
    "expected a frame id, .* got 'a ?/1? ?'": [
        ([record("a/1", **wrong)], ONE)
        for wrong in ({"sequence": "a "}, {"name": "1 "}, {"name": ""})
    ],
    "expected the name of a frame without '/', got 'b/1'": [([record("a/1", name="b/1")], ONE)],
    r"UTF-8 in the id of a frame, got 'a/\\udcff'": [(["a/\udcff"], ONE)],
    "frame 'a/1': expected a pose of finite x, y, heading": [
        ([record("a/1", **pose)], ONE)
        for pose in ({"x": 1.0}, {"x": math.inf, "y": 2}, {"heading": math.inf})
    ],
    "origin 'feed' is not in": [([record("a/1", origin="feed")], ONE)],
    "expected a list of frames, got the text 'ab'": [("ab", torch.ones(2, 480))],
    "'day/2' is in": [
        (frames, torch.ones(2, 480)) for frames in (["a/1", "day/2"], ["day/2", "a/1"])
    ],
    "'a/1' is there 2 times": [(["a/1", "a/1"], torch.ones(2, 480))],
}


@pytest.mark.parametrize("message", REFUSED)
def test_wrong_frames_are_refused_and_nothing_is_added(path, message):
    before = loaded(path)
    for frames, numbers in REFUSED[message]:
        refuses(message, Database.open(path).append, frames, numbers)
    assert loaded(path) == before


def test_a_path_that_is_not_a_database_is_refused_and_not_changed(path, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter.txt").write_text("dear")
    foreign = pa.table({"a": [1]})
    lance.write_dataset(foreign, tmp_path / "table")
    old = foreign.replace_schema_metadata({"ssrvlad": '{"format": "ssrvlad-database-0"}'})
    lance.write_dataset(old, tmp_path / "old")
    for name, message in {
        "folder": "folder is not a database",
        "folder/letter.txt": r"letter\.txt is not a database",
        "missing": "missing does not exist",
        "table": "is a table of Lance, but not a database",
        "old": r"old has another format, ssrvlad-database-0: encode it again$",
    }.items():
        refuses(message, Database.open, tmp_path / name)
    for name in ("folder", "folder/letter.txt"):
        refuses("exists and is not a database", Database.create, tmp_path / name, CONFIG)
    assert [entry.name for entry in (tmp_path / "folder").iterdir()] == ["letter.txt"]
    refuses("is a database already", Database.create, path, CONFIG)
    refuses(r"expected Database\.open\('town.ssrdb'\)", Database, "town.ssrdb")
    assert len(Database.open(path)) == len(FRAMES)


@pytest.mark.parametrize(
    ("path", "width", "message"),
    [
        (None, 3, "expected the folder or URI of a database, got None"),
        ("db", 2.5, "width: expected an integer from 1, got 2.5"),
        ("db", -1, "width: expected an integer from 1, got -1"),
        ("db", None, r"config .* or the width"),
    ],
)
def test_a_database_of_wrong_path_or_width_is_refused(tmp_path, path, width, message):
    refuses(message, Database.create, path and tmp_path / path, width=width)
    assert not any(tmp_path.iterdir())


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
    refuses("is damaged", Database.open(path).load)
    [damage] = Database.open(path).damage()
    assert (damage.file, damage.rows) == (f"data/{lost.name}", 4)
    Database.open(path).drop_damaged()
    assert list(loaded(path)) == ["other/1"]


def test_of_a_database_whose_newest_manifests_are_half_written_an_earlier_version_is_named(path):
    before = loaded(path)
    fill(Database.open(path), ["lost/1"])
    fill(Database.open(path), ["lost/2"])
    newest = sorted(path.glob("_versions/*.manifest"))[:2]
    for manifest, size in zip(newest, (0, 60), strict=True):
        manifest.write_bytes(manifest.read_bytes()[:size])
    refuses("cannot be opened: .*; --as-of 2 reads an earlier version", Database.open, path)
    assert loaded(path, version=2) == before
    for manifest in newest:
        manifest.unlink()
    assert loaded(path) == before
    fill(Database.open(path), ["lost/1"])
    assert len(loaded(path)) == len(before) + 1
    assert Database.open(path).damage() == []


@pytest.mark.parametrize("of", [Database.open, Database.exists, Map.open])
def test_a_uri_as_a_path_is_no_folder(of):
    refuses("expected a URI with two slashes", of, Path("s3://town/morning.ssrdb"))


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
