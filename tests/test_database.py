"""A database on disk: round trips, errors, versions, several writers, and damage."""

import math
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import lance
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import torch
import yaml
from helpers import descriptors, record, spoil
from hypothesis import given
from hypothesis import strategies as st

import ssrvlad_torch.config as config_module
from ssrvlad_torch import Database, SSRVLADConfig
from ssrvlad_torch.database import engine
from ssrvlad_torch.database.frame_sets import order_of
from ssrvlad_torch.database.frames import natural_key
from ssrvlad_torch.taxonomy import LabelClass, LabelSpace, label_space

CONFIG = SSRVLADConfig.from_preset("default", labels_as="camvid-11")
FRAMES = ["day/10", "day/2", "night/1", "day/9"]
SORTED = ("day/2", "day/9", "day/10", "night/1")


@pytest.fixture
def path(tmp_path):
    fill(Database.create(tmp_path / "town.ssrdb", CONFIG), FRAMES)
    return tmp_path / "town.ssrdb"


def fill(into, frames, seed=0):
    into.append([record(frame) for frame in frames], descriptors(seed, len(frames)))


def loaded(path, **which):
    frames = Database.open(path, **which).load()
    return dict(zip(frames.frames, frames.descriptors.tolist(), strict=True))


def one_line(refusal):
    message = str(refusal.value)
    assert "\n" not in message
    return message


# ---- round trip


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


@given(st.permutations(["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]))
def test_natural_keys(names):
    expected = ["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]
    assert sorted(names, key=natural_key) == expected


@given(st.permutations(["7.5", "102.0", "102.125", "102.25", "102.5", "102.75", "103.000001", "a"]))
def test_decimal_times_are_ordered_by_value(names):
    expected = ["7.5", "102.0", "102.125", "102.25", "102.5", "102.75", "103.000001", "a"]
    assert sorted(names, key=natural_key) == expected


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


# ---- settings and origins


def test_an_error_about_other_settings_shows_both_fingerprints_and_the_difference(path):
    other = SSRVLADConfig.from_preset("paper", rings=4)
    for refuse in (Database.open_or_create, lambda path, c: Database.open(path).require(c)):
        with pytest.raises(ValueError) as refusal:
            refuse(path, other)
        message = one_line(refusal)
        assert CONFIG.fingerprint in message
        assert other.fingerprint in message
        assert "working_size 120 there and None here" in message
        assert "labels_as" not in message


def test_another_revision_of_the_method_is_refused(path, monkeypatch):
    """The same settings give other descriptors there."""
    monkeypatch.setitem(config_module.METHOD_REVISIONS, "harmonics", 99)
    with pytest.raises(ValueError, match="another version of the method") as refusal:
        Database.open(path)
    one_line(refusal)


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


# ---- wrong arguments


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


@pytest.mark.parametrize("frame", ["", " ", "a/", "/1", " a/1", "a/1\n"])
def test_an_invalid_id_is_refused(path, frame):
    with pytest.raises(ValueError, match="expected a frame id, <sequence>/<name> or <name>, got "):
        Database.open(path).append([frame], torch.ones(1, 480))
    with pytest.raises(ValueError, match="has no name"):
        Database.open(path).append([record("a/1")._replace(name="")], torch.ones(1, 480))


def test_a_single_text_is_not_a_list_of_ids(path):
    with pytest.raises(ValueError, match="expected a list of frames, got the text 'ab'"):
        Database.open(path).append("ab", torch.ones(2, 480))
    with pytest.raises(ValueError, match="got the text 'day/1'"):
        Database.open(path).remove("day/1")


@pytest.mark.parametrize("frames", [["a/1", "day/2"], ["day/2", "a/1"], ["a/1", "a/1"]])
def test_an_append_with_a_stored_frame_adds_nothing(path, frames):
    before = loaded(path)
    with pytest.raises(ValueError, match=r"'day/2' is in|'a/1' is given 2 times") as refusal:
        fill(Database.open(path), frames)
    one_line(refusal)
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
    for name in ("folder", "folder/letter.txt"):
        with pytest.raises(ValueError, match="exists and is not a database"):
            Database.create(tmp_path / name, CONFIG)
    assert [entry.name for entry in (tmp_path / "folder").iterdir()] == ["letter.txt"]


def foreign_table():
    return pa.table({"a": [1]})


def test_a_database_of_an_earlier_format_gets_one_line(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match="earlier format of database: encode it again"):
        Database.open(tmp_path)
    assert Database.exists(tmp_path)


def test_a_database_is_not_created_over_one(path):
    with pytest.raises(ValueError, match="is a database already"):
        Database.create(path, CONFIG)
    assert len(Database.open(path)) == len(FRAMES)


# ---- versions


def test_merges_and_removals_are_one_commit_each_and_are_in_the_history(path):
    database = Database.open(path)
    database.merge(["day/2", "night/1"], torch.zeros(2, 480))
    assert database.load().empty.tolist() == [True, False, False, True]
    database.merge(["day/2", "new/1"], descriptors(5, 2))
    assert database.load().frames == ("day/2", "day/9", "day/10", "new/1", "night/1")
    assert not database.load().empty[0]
    database.remove({"day/9", "day/10", "never/1"})
    assert database.load().frames == ("day/2", "new/1", "night/1")
    changes = [(entry.frames, entry.change.split()[0]) for entry in database.history()]
    assert changes == [(0, "create"), (4, "append"), (4, "merge"), (5, "merge"), (3, "remove")]
    first = database.history()[1].version
    assert torch.equal(
        Database.open(path, first).load().descriptors, descriptors(0, 4)[[1, 3, 0, 2]]
    )
    with pytest.raises(ValueError, match="as of version"):
        Database.open(path, first).remove(["day/2"])
    with pytest.raises(ValueError, match="has no version 99"):
        Database.open(path, 99)


def test_a_database_takes_frames_after_all_were_removed(path):
    database = Database.open(path)
    database.remove(FRAMES)
    assert len(database.load()) == 0
    fill(database, ["a/1"])
    assert list(loaded(path)) == ["a/1"]


def test_a_reader_keeps_its_version_while_others_write(path):
    reader, writer = Database.open(path), Database.open(path)
    before = reader.load()
    writer.merge(["day/2"], torch.zeros(1, 480))
    writer.remove(["day/9"])
    writer.compact()
    assert torch.equal(reader.load().descriptors, before.descriptors)
    assert list(reader.known()) == FRAMES


def test_compacting_keeps_the_versions_that_someone_uses(path, monkeypatch):
    """A reader, and a writer whose change is planned on a version that is then superseded."""
    reader, writer, plan = Database.open(path), Database.open(path), engine.replacement
    before = reader.load()

    def meanwhile(*arguments):
        monkeypatch.setattr(engine, "replacement", plan)
        other = Database.open(path)
        other.append(["b/1"], descriptors(1, 1))
        other.compact(keep_days=0)
        other.add_origin(None, "network")
        other.compact(keep_days=0)
        return plan(*arguments)

    monkeypatch.setattr(engine, "replacement", meanwhile)
    writer.merge(["a/1", "b/1"], descriptors(2, 2))
    rows = loaded(path)
    assert set(rows) == {*FRAMES, "a/1", "b/1"}
    assert rows["b/1"] == descriptors(2, 2)[1].tolist()
    assert torch.equal(reader.load().descriptors, before.descriptors)
    reader.merge(["b/2"], descriptors(3, 1))
    del writer
    reader.compact(keep_days=0)
    assert len(reader.history()) == 1


def test_compacting_joins_files_and_deletes_old_versions(path):
    database = Database.open(path)
    for number in range(6):
        fill(database, [f"more/{number}"], number)
    database.remove(["day/2"])
    before, files = loaded(path), len(list(path.glob("data/*.lance")))
    database.compact(keep_days=0)
    assert loaded(path) == before
    assert len(list(path.glob("data/*.lance"))) < files
    assert len(database.history()) == 1
    fill(database, ["day/2"])
    assert len(Database.open(path)) == len(before) + 1


def test_rows_that_were_written_apart_are_added_when_they_are_adopted(path):
    database = Database.open(path)
    written = [database.write_apart([f"a/{n}"], descriptors(n, 1)) for n in range(3)]
    assert len(Database.open(path)) == len(FRAMES)
    with pytest.raises(ValueError, match="written twice"):
        database.adopt([written[0], *written])
    database.adopt(written)
    assert loaded(path)["a/1"] == descriptors(1, 1)[0].tolist()
    with pytest.raises(ValueError, match="'a/0' is in"):
        database.adopt(written)


# ---- several writers


def test_a_change_is_checked_against_what_others_have_written(path):
    """Not against the version that the writer has read."""
    database, seen = Database.open(path), []

    def check(known):
        seen.append(sorted(known))
        if "other/0" in known:
            raise ValueError("other/0 is there")

    database.merge(["a/0"], descriptors(0, 1), check=check)
    assert not seen
    Database.open(path).append(["other/0"], descriptors(1, 1))
    written = [database.write_apart(["a/1"], descriptors(2, 1))]
    for change in (
        database.adopt,
        lambda rows, check: database.merge(["a/2"], descriptors(3, 1), check=check),
    ):
        with pytest.raises(ValueError, match="other/0 is there"):
            change(written, check)
    assert seen == [sorted([*FRAMES, "a/0", "other/0"])] * 2
    assert len(Database.open(path)) == len(FRAMES) + 2


def add_own(path, name, count):
    database = Database.open(path)
    for number in range(count):
        fill(database, [f"{name}/{number}"], number)


def test_two_processes_that_add_at_once_both_succeed(tmp_path):
    path = tmp_path / "db"
    Database.create(path, CONFIG)
    spawn = multiprocessing.get_context("spawn")
    writers = [spawn.Process(target=add_own, args=(path, name, 5)) for name in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    expected = {f"{name}/{n}": descriptors(n, 1)[0].tolist() for name in "ab" for n in range(5)}
    assert loaded(path) == expected


def in_threads(*works):
    """Runs functions in threads at once, and returns their errors."""
    errors, ready = [], threading.Barrier(len(works))

    def attempt(work):
        ready.wait()
        try:
            work()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=attempt, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return errors


def test_writers_that_start_at_once_make_one_database(tmp_path):
    path = tmp_path / "db"
    opening = [
        lambda n=n: fill(Database.open_or_create(path, CONFIG), [f"{n}/0"]) for n in range(4)
    ]
    assert in_threads(*opening) == []
    assert set(loaded(path)) == {f"{n}/0" for n in range(4)}


@pytest.mark.parametrize("version", [0, -1, 99])
def test_a_version_that_is_not_there_is_refused(path, version):
    with pytest.raises(ValueError, match=f"has no version {version}") as refusal:
        Database.open(path, version)
    assert one_line(refusal)


FORKED = """
import os, sys, warnings
warnings.simplefilter("always")
from ssrvlad_torch import Database
database = Database.open(sys.argv[1])
database.load()
if os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
os._exit([len(Database.open(sys.argv[1]).load()), len(database.load())] != [len(database)] * 2)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_reads_on_and_nothing_is_warned_of(path):
    """As the workers of a DataLoader are."""
    command = [sys.executable, "-c", FORKED, path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_two_threads_that_share_a_database_both_succeed(path):
    database = Database.open(path)

    def adding(name):
        return lambda: [fill(database, [f"{name}/{n}"], n) for n in range(10)]

    assert in_threads(adding("a"), adding("b")) == []
    assert len(loaded(path)) == len(FRAMES) + 20
    assert len(database) == len(FRAMES) + 20


@pytest.mark.parametrize("empty", [True, False])
def test_of_several_writers_of_one_frame_one_succeeds(tmp_path, empty):
    path = tmp_path / "db"
    Database.create(path, CONFIG)
    if not empty:
        fill(Database.open(path), FRAMES)
    handles = [Database.open(path) for _ in range(4)]
    works = [
        lambda h=h, n=n: h.append(["same/1"], descriptors(n, 1)) for n, h in enumerate(handles)
    ]
    errors = in_threads(*works)
    assert len(errors) == 3
    assert {str(error) for error in errors} == {f"frame 'same/1' is in {path} already"}
    assert len(loaded(path)) == (1 if empty else 5)


def test_concurrent_changes_of_all_kinds_are_applied_one_after_another(path):
    """Each writer changes only its own frames, so every order gives the same result."""

    def changing(name):
        def work():
            database = Database.open(path)
            fill(database, [f"{name}/{n}" for n in range(4)])
            database.remove([f"{name}/0"])
            database.merge([f"{name}/1"], torch.zeros(1, 480))
            database.merge([f"{name}/2", f"{name}/5"], descriptors(9, 2))
            database.add_origin(None, name)

        return work

    def compacting():
        for _ in range(3):
            Database.open(path).compact()

    assert in_threads(changing("a"), changing("b"), changing("c"), compacting) == []
    rows = loaded(path)
    assert set(rows) == {*FRAMES, *(f"{name}/{n}" for name in "abc" for n in (1, 2, 3, 5))}
    for name in "abc":
        assert not any(rows[f"{name}/1"])
        assert rows[f"{name}/2"] == descriptors(9, 2)[0].tolist()
        assert rows[f"{name}/3"] == descriptors(0, 4)[3].tolist()
    assert {origin.segmenter for origin in Database.open(path).origins.values()} == {"a", "b", "c"}


# ---- damage


def data_file(path):
    [file] = Path(path).glob("data/*.lance")
    return file


def test_a_changed_byte_of_a_data_file_is_reported_or_has_no_effect(path):
    whole, before = data_file(path).read_bytes(), loaded(path)
    refused, positions = 0, range(0, len(whole), 149)
    for position in positions:
        changed = bytearray(whole)
        changed[position] ^= 1 << position % 8
        data_file(path).write_bytes(changed)
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
    with pytest.raises(
        ValueError,
        match=r"town\.ssrdb is damaged: data/\w+\.lance: the checksum of frame 'day/9' differs",
    ):
        Database.open(path).load()
    database = Database.open(path)
    damage = database.damage()
    assert [(entry.file, entry.rows) for entry in damage] == [(f"data/{data_file(path).name}", 1)]
    assert damage == database.drop_damaged()
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
    with pytest.raises(ValueError, match="is damaged") as refusal:
        Database.open(path).load()
    one_line(refusal)
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
    with pytest.raises(ValueError, match=message) as refusal:
        Database.open(path)
    one_line(refusal)
    assert loaded(path, version=2) == before
    for manifest in newest:
        manifest.unlink()
    assert loaded(path) == before
    fill(Database.open(path), ["lost/1"])
    assert len(loaded(path)) == len(before) + 1
    assert Database.open(path).damage() == []


def test_a_custom_label_space_is_stored_whole(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(label_space("camvid-11").to_dict()))
    Database.create(tmp_path / "db", SSRVLADConfig.from_preset("default", labels_as=file))
    file.unlink()
    config = Database.open(tmp_path / "db").config
    assert label_space(config.labels_as).digest == label_space("camvid-11").digest
