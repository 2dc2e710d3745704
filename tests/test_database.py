"""A database on disk: round trips, settings and wrong arguments."""

import math

import lance
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import torch
from four_frames import CONFIG, FRAMES, SORTED, fill, filled, loaded
from helpers import descriptors, record, refused
from hypothesis import given
from hypothesis import strategies as st

import ssrvlad_torch.config as config_module
from ssrvlad_torch import Database, SSRVLADConfig
from ssrvlad_torch.database.frame_sets import order_of
from ssrvlad_torch.files import natural_key
from ssrvlad_torch.taxonomy import LabelClass, LabelSpace, label_space


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
    database = Database.create(tmp_path / "db", width=7)
    numbers = descriptors(0, 3, 7)
    database.append(["one", "drive/2", "drive/10"], numbers.numpy())
    opened = Database.open(tmp_path / "db")
    assert opened.load().frames == ("one", "drive/2", "drive/10")
    assert torch.equal(opened.load().descriptors, numbers)
    assert (opened.fingerprint, opened.width) == ("", 7)
    assert opened.info()["config"] is None
    with pytest.raises(ValueError, match="without settings"):
        opened.require(CONFIG)
    with pytest.raises(ValueError, match=r"config .* or the width"):
        Database.create(tmp_path / "other")


def test_an_empty_database_is_a_database(tmp_path):
    assert Database.create(tmp_path / "db", CONFIG)
    frames = Database.open(tmp_path / "db").load()
    assert frames.frames == ()
    assert frames.descriptors.shape == (0, 480)
    assert frames.poses.shape == (0, 3)


def test_frames_are_in_natural_order_however_they_were_added(path, tmp_path):
    assert Database.open(path).load().frames == SORTED
    one_by_one = Database.create(tmp_path / "other", CONFIG)
    for frame in reversed(FRAMES):
        fill(one_by_one, [frame])
    assert one_by_one.load().frames == one_by_one.placed()[0].frames == SORTED


@given(
    st.sampled_from(["{:03d}", "a{:06d}.{:02d}", "²{:04d}\n{:03d}"])
    | st.sampled_from(["{}", "{}-{}"]),
    st.lists(st.tuples(*[st.integers(0, 99)] * 2), min_size=1, max_size=9, unique=True),
)
def test_frames_whose_names_differ_only_in_digits_are_in_natural_order(form, numbers):
    names = {f"{sequence}/{form.format(*pair)}" for pair in numbers for sequence in "ba"}
    table = pa.table({"frame": sorted(names, reverse=True)})
    table = table.append_column("sequence", pc.utf8_slice_codeunits(table["frame"], 0, 1))
    expected = sorted(names, key=lambda frame: (frame[0], natural_key(frame[2:])))
    assert table["frame"].take(order_of(table)).to_pylist() == expected


def test_an_error_about_other_settings_shows_both_fingerprints_and_the_difference(path):
    other = SSRVLADConfig.from_preset("paper", rings=4)
    for refuse in (Database.open_or_create, lambda path, c: Database.open(path).require(c)):
        message = "working_size 120 there and None here"
        with refused(message, CONFIG.fingerprint, other.fingerprint) as refusal:
            refuse(path, other)
        assert "labels_as" not in str(refusal.value)


def test_another_revision_of_the_method_is_refused(path, monkeypatch):
    """The same settings give other descriptors there."""
    monkeypatch.setitem(config_module.METHOD_REVISIONS, "harmonics", 99)
    with refused("another version of the method"):
        Database.open(path)


def test_each_row_names_the_label_space_and_segmenter_that_made_it(path):
    database = Database.open(path)
    spaces = [label_space("camvid-11"), edited(label_space("camvid-11"))]
    keys = [database.add_origin(space) for space in spaces] + [database.add_origin(None, "net")]
    assert len(set(keys)) == 3, "an edited label space of the same name is another"
    assert database.add_origin(spaces[0]) == keys[0]
    fill(database, ["a/0"])
    database.append([record(f"b/{k}", origin=k) for k in keys], descriptors(2, 3))
    known, origins = Database.open(path).known(), Database.open(path).origins
    assert [origins[known[f"b/{key}"].origin].label_space for key in keys] == [*spaces, None]
    with pytest.raises(ValueError, match="origin 'feed' is not in"):
        database.append([record("c/0", origin="feed")], descriptors(3, 1))


def edited(space):
    first = space.classes[0]
    changed = LabelClass(first.id, first.name, "building", first.colour)
    return LabelSpace(space.name, space.source, (changed, *space.classes[1:]))


@pytest.mark.parametrize("shape", [(1, 480), (3, 480), (2, 479), (2, 1, 480), (960,)])
def test_descriptors_of_another_shape_are_refused(path, shape):
    with pytest.raises(ValueError, match=r"expected \(2, 480\)"):
        Database.open(path).append(["a/1", "a/2"], torch.zeros(shape))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (torch.nan, "not finite"),
        (torch.inf, "not finite"),
        (3e38, "too large for float32 to measure"),
        (1e-30, "too small for float32 to measure"),
    ],
)
def test_descriptors_without_a_length_are_refused(path, value, message):
    with pytest.raises(ValueError, match=message):
        Database.open(path).append(["a/1"], torch.full((1, 480), value))
    for numbers in (np.full((1, 480), 1j), np.full((1, 480), "1")):
        with pytest.raises(ValueError, match="descriptor: expected real numbers, got "):
            Database.open(path).append(["a/1"], numbers)


@pytest.mark.parametrize("frame", ["", " ", "a/", "/1", " a/1", "a/1\n"])
def test_an_invalid_id_is_refused(path, frame):
    with pytest.raises(ValueError, match="expected a frame id, <sequence>/<name> or <name>, got "):
        Database.open(path).append([frame], torch.ones(1, 480))
    with pytest.raises(ValueError, match="has no name"):
        Database.open(path).append([record("a/1")._replace(name="")], torch.ones(1, 480))
    for wrong in ({"sequence": "a "}, {"name": "1 "}, {"name": "b/1"}):
        with pytest.raises(ValueError, match=r"expected a frame id|frame without '/', got 'b/1'"):
            Database.open(path).append([record("a/1")._replace(**wrong)], torch.ones(1, 480))
    with pytest.raises(ValueError, match=r"UTF-8 in the id of a frame, got 'a/\\udcff'"):
        Database.open(path).append(["a/\udcff"], torch.ones(1, 480))


@pytest.mark.parametrize("pose", [{"x": 1.0}, {"x": math.inf, "y": 2}, {"heading": math.inf}])
def test_a_pose_that_is_not_finite_is_refused(path, pose):
    with pytest.raises(ValueError, match="frame 'a/1': expected a pose of finite x, y, heading"):
        Database.open(path).append([record("a/1")._replace(**pose)], torch.ones(1, 480))


def test_a_single_text_is_not_a_list_of_ids(path):
    with pytest.raises(ValueError, match="expected a list of frames, got the text 'ab'"):
        Database.open(path).append("ab", torch.ones(2, 480))
    with pytest.raises(ValueError, match="got the text 'day/1'"):
        Database.open(path).remove("day/1")


@pytest.mark.parametrize("frames", [["a/1", "day/2"], ["day/2", "a/1"], ["a/1", "a/1"]])
def test_an_append_with_a_stored_frame_adds_nothing(path, frames):
    before = loaded(path)
    with refused(r"'day/2' is in|'a/1' is given 2 times"):
        fill(Database.open(path), frames)
    assert loaded(path) == before


def test_a_path_that_is_not_a_database_is_refused_and_not_changed(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter.txt").write_text("dear")
    lance.write_dataset(foreign_table(), tmp_path / "table")
    for name in ("folder", "folder/letter.txt"):
        with pytest.raises(ValueError, match=r"is not a database"):
            Database.open(tmp_path / name)
    with pytest.raises(ValueError, match="missing does not exist"):
        Database.open(tmp_path / "missing")
    with pytest.raises(ValueError, match="is a table of Lance, but not a database"):
        Database.open(tmp_path / "table")
    old = foreign_table().replace_schema_metadata({"ssrvlad": '{"format": "ssrvlad-database-0"}'})
    lance.write_dataset(old, tmp_path / "old")
    with refused(r"old was made by an earlier format of database: encode it again$"):
        Database.open(tmp_path / "old")
    for name in ("folder", "folder/letter.txt"):
        with pytest.raises(ValueError, match="exists and is not a database"):
            Database.create(tmp_path / name, CONFIG)
    assert [entry.name for entry in (tmp_path / "folder").iterdir()] == ["letter.txt"]


def foreign_table():
    return pa.table({"a": [1]})


@pytest.mark.parametrize(
    ("path", "width", "message"),
    [
        (None, 3, "expected the folder or URI of a database, got None"),
        ("db", 2.5, "width: expected an integer from 1, got 2.5"),
        ("db", -1, "width: expected an integer from 1, got -1"),
    ],
)
def test_what_no_database_can_be_created_with_is_refused(tmp_path, path, width, message):
    with pytest.raises(ValueError, match=message):
        Database.create(path and tmp_path / path, width=width)
    assert not any(tmp_path.iterdir())


def test_a_database_is_not_created_over_one(path):
    with pytest.raises(ValueError, match="is a database already"):
        Database.create(path, CONFIG)
    assert len(Database.open(path)) == len(FRAMES)
