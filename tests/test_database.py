"""The database on disk: what went in comes out, and what is wrong is named."""

import errno
import io
import json
import multiprocessing
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from helpers import descriptors, flip_byte, record
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch import config as config_module
from ssrvlad_torch.database.database import Database, natural_key
from ssrvlad_torch.database.storage import manifest
from ssrvlad_torch.recognition.matching import temporal_sum

CONFIG = SSRVLADConfig(labels_as="camvid-11")
FRAMES = ("day/1", "day/2", "day/10", "night/1")
PART = "part-000000.parquet"


@pytest.fixture
def path(tmp_path):
    """A database of one part with `FRAMES`."""
    fill(Database.create(tmp_path / "town.ssrdb", CONFIG), FRAMES)
    return tmp_path / "town.ssrdb"


def fill(into, frames, seed=0):
    into.append([record(frame) for frame in frames], descriptors(seed, len(frames)))
    return into


def files(path):
    return sorted(entry.name for entry in path.iterdir())


def edit_manifest(path, **changes):
    """Writes other values into the manifest, with a checksum that fits."""
    document = json.loads((path / "manifest.json").read_text())
    document.update(changes)
    del document["checksum"]
    document["checksum"] = manifest._checksum(document)
    (path / "manifest.json").write_text(json.dumps(document))


def one_line(refusal):
    message = str(refusal.value)
    assert message
    assert "\n" not in message
    return message


# ---- round trip


def test_what_went_in_comes_out_bit_for_bit(tmp_path):
    numbers = descriptors(1, 3)
    numbers[1] = 0
    numbers[2, :3] = torch.tensor([-0.0, 1e-40, torch.finfo(torch.float32).max])
    records = [
        record("a/2", x=1 / 3, y=-0.0, heading=np.pi, height=720, width=960, digest="ff" * 16),
        record("a/1", labels_as="synthia", x=1e300),
        record("a/straße 🚗"),
    ]
    Database.create(tmp_path / "db", CONFIG).append(records, numbers)

    opened = Database.open(tmp_path / "db")
    frames = opened.load()
    assert opened.config == CONFIG
    assert len(opened) == 3
    assert frames.frames == ("a/1", "a/2", "a/straße 🚗")
    assert frames.sequences == ("a", "a", "a")
    order = [1, 0, 2]
    assert frames.descriptors.dtype == torch.float32
    assert frames.descriptors.numpy().tobytes() == numbers[order].numpy().tobytes()
    poses = np.array([[records[row].x, records[row].y, records[row].heading] for row in order])
    assert frames.poses.tobytes() == poses.tobytes(), "NaN and -0 too"
    assert frames.empty.tolist() == [True, False, False]
    rows = opened.table().to_pylist()
    for row, stored in zip(rows, records, strict=True):
        del row["descriptor"]
        assert repr(row) == repr(stored._asdict())
    assert opened.digests() == {stored.frame: stored.digest for stored in records}


def test_reading_starts_no_threads_that_could_outlive_it(tmp_path):
    """pyarrow's abort a process that ends while they wind up."""
    database = Database.create(tmp_path / "db", CONFIG)
    for part in range(3):
        fill(database, [f"{part}/{n}" for n in range(2000)], seed=part)
    script = """if True:
        import os, sys
        from ssrvlad_torch import Database
        from ssrvlad_torch.database.storage.verification import verify
        before = len(os.listdir("/proc/self/task"))
        Database.open(sys.argv[1]).load()
        Database.open(sys.argv[1]).known()
        assert verify(sys.argv[1]) == []
        print(len(os.listdir("/proc/self/task")) - before)
    """
    done = subprocess.run(
        [sys.executable, "-c", script, database.path], capture_output=True, text=True, check=True
    )
    assert done.stdout == "0\n"


def test_an_empty_database_is_a_database(tmp_path):
    Database.create(tmp_path / "deep" / "db", CONFIG)
    opened = Database.open(tmp_path / "deep" / "db")
    assert len(opened) == 0
    assert opened.digests() == {}
    assert opened.table(["digest"]).column_names == ["digest"]
    frames = opened.load(temporal=3)
    assert frames.frames == ()
    assert frames.descriptors.shape == (0, 480)
    assert frames.poses.shape == (0, 3)


def test_appending_nothing_writes_nothing(path):
    before = files(path)
    Database.open(path).append([], torch.zeros(0, 480))
    assert files(path) == before


def test_parts_add_up_and_the_order_is_that_of_a_person(path):
    fill(Database.open(path), ["night/0", "day/3"], seed=1)
    fill(Database.open(path), ["dawn/5"], seed=2)
    frames = Database.open(path).load()
    assert frames.frames == (
        "dawn/5", "day/1", "day/2", "day/3", "day/10", "night/0", "night/1"
    )  # fmt: skip
    stored = torch.cat([descriptors(0, 4), descriptors(1, 2), descriptors(2, 1)])
    assert torch.equal(frames.descriptors, stored[[6, 0, 1, 5, 2, 4, 3]])
    assert len(Database.open(path)) == 7


def test_the_order_does_not_depend_on_that_of_adding(tmp_path):
    """Not even where two names are the same number."""
    frames = ["a/01", "a/1", "a/001", "a/1b", "a/b", "a/10"]
    loaded = []
    for name, order in (("x", frames), ("y", frames[::-1])):
        fill(Database.create(tmp_path / name, CONFIG), order)
        loaded.append(Database.open(tmp_path / name).load().frames)
    assert loaded[0] == loaded[1] == ("a/001", "a/01", "a/1", "a/1b", "a/10", "a/b")


@pytest.mark.parametrize("reach", [0, 1, 3, 50])
def test_the_temporal_sum_is_made_at_loading_inside_each_sequence(path, reach):
    fill(Database.open(path), ["night/0", "day/3"], seed=1)
    raw = Database.open(path).load()
    assert raw.sequences == ("day",) * 4 + ("night",) * 2
    summed = Database.open(path).load(temporal=reach)
    wanted = temporal_sum(raw.descriptors, raw.sequences, reach)
    torch.testing.assert_close(summed.descriptors, wanted, rtol=0, atol=1e-7 if not reach else 0)


def test_a_frame_is_empty_by_its_own_descriptor(tmp_path):
    numbers = descriptors(0, 3)
    numbers[1] = 0
    Database.create(tmp_path / "db", CONFIG).append(
        [record(f"a/{row}") for row in range(3)], numbers
    )
    assert Database.open(tmp_path / "db").load(temporal=1).empty.tolist() == [False, True, False]


def test_a_handle_sees_what_it_appended_and_what_others_did(path):
    first, second = Database.open(path), Database.open(path)
    fill(first, ["a/1"])
    assert "a/1" in first.digests()
    fill(second, ["a/2"])
    assert set(second.digests()) == {*FRAMES, "a/1", "a/2"}
    with pytest.raises(ValueError, match="'a/2' is in"):
        fill(first, ["a/2"])
    assert len(Database.open(path)) == 6


@given(st.permutations(["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]))
def test_natural_keys_order_as_a_person_would(names):
    wanted = ["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]
    assert sorted(names, key=natural_key) == wanted


@given(st.text("aA0129_-", max_size=6), st.text("aA0129_-", max_size=6))
def test_natural_keys_tell_names_apart(one, other):
    assert (natural_key(one) == natural_key(other)) == (one == other)


# ---- settings


def test_other_settings_are_refused_with_both_fingerprints_and_what_differs(path):
    other = SSRVLADConfig.from_preset("paper", rings=4)
    for refuse in (Database.open_or_create, lambda path, c: Database.open(path).require(c)):
        with pytest.raises(ValueError) as refusal:
            refuse(path, other)
        message = one_line(refusal)
        assert CONFIG.fingerprint in message
        assert other.fingerprint in message
        assert "working_size 120 there and None here" in message
        assert "rings 6 there and 4 here" in message
        assert "labels_as" not in message
        assert "thinning" not in message
    assert len(Database.open(path)) == len(FRAMES)


def test_the_label_space_is_no_part_of_the_fingerprint(path):
    opened = Database.open_or_create(path, SSRVLADConfig(labels_as="synthia"))
    assert opened.config.labels_as == "camvid-11"
    assert len(opened) == len(FRAMES)


def test_open_or_create_creates(tmp_path):
    assert len(Database.open_or_create(tmp_path / "db", CONFIG)) == 0
    assert Database.exists(tmp_path / "db")


def test_another_revision_of_the_method_is_refused(path, monkeypatch):
    """The same settings would give other numbers."""
    there = CONFIG.fingerprint
    monkeypatch.setattr(config_module, "METHOD_REVISION", config_module.METHOD_REVISION + 1)
    with pytest.raises(ValueError) as refusal:
        Database.open(path)
    message = one_line(refusal)
    assert there in message
    assert CONFIG.fingerprint in message
    assert "another version of the method" in message


def test_a_setting_that_this_version_lacks_is_refused(path):
    edit_manifest(path, config={**CONFIG.to_dict(), "anchors": 3})
    with pytest.raises(ValueError, match=r"town\.ssrdb has settings of another version.*'anchors'"):
        Database.open(path)


# ---- what append refuses


@pytest.mark.parametrize("shape", [(1, 480), (3, 480), (2, 479), (2, 1, 480), (960,)])
def test_descriptors_of_another_shape_are_refused(path, shape):
    with pytest.raises(ValueError, match=r"wanted \(2, 480\) descriptors for 2 frames, got"):
        Database.open(path).append([record("a/1"), record("a/2")], torch.zeros(shape))
    assert len(Database.open(path)) == len(FRAMES)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_descriptors_that_are_not_finite_are_refused(path, value):
    """One of them would make every later query fail."""
    numbers = descriptors(0, 2)
    numbers[1, 7] = value
    with pytest.raises(ValueError, match="not finite"):
        Database.open(path).append([record("a/1"), record("a/2")], numbers)
    assert len(Database.open(path)) == len(FRAMES)


@pytest.mark.parametrize("frames", [["a/1", "day/2"], ["day/2", "a/1", "a/1"], ["a/1", "a/1"]])
def test_a_frame_that_is_there_is_refused_with_all_that_came_along(path, frames):
    opened = Database.open(path)
    with pytest.raises(ValueError, match=r"frame '(day/2|a/1)' is in .* already"):
        fill(opened, frames)
    assert files(path) == sorted(["lock", "manifest.json", PART])
    assert set(Database.open(path).digests()) == set(FRAMES)
    assert len(fill(opened, ["a/1"])) == len(FRAMES) + 1


# ---- damage


def test_damage_anywhere_in_a_part_is_refused_or_without_effect(tmp_path):
    """Pages have checksums; what lies between them is the format's own business."""
    small = SSRVLADConfig(rings=1, sectors=1, harmonics=1)
    made = Database.create(tmp_path / "db", small)
    made.append([record("a/1", x=1.0), record("b/2")], descriptors(0, 2, 8))
    part = tmp_path / "db" / PART
    whole, rows = part.read_bytes(), repr(made.table().to_pydict())
    refused = 0
    every_bit_of_a_header = [(position, 1 << bit) for position in range(40) for bit in range(8)]
    here_and_there = [(position, 0x55) for position in range(40, len(whole), 11)]
    for position, bits in every_bit_of_a_header + here_and_there:
        part.write_bytes(whole)
        flip_byte(part, position, bits)
        try:
            opened = Database.open(tmp_path / "db")
            opened.load()
            opened.digests()
            assert repr(opened.table().to_pydict()) == rows, position
        except ValueError as error:
            assert PART in str(error)
            refused += 1
    assert refused > 200


def test_a_flipped_byte_of_the_descriptors_is_found_by_the_checksum_of_its_page(path):
    """The numbers lie in the file as they are, so without the checksum this would be a number."""
    part = path / PART
    pages = pq.ParquetFile(part).metadata.row_group(0).column(9)
    flip_byte(part, pages.data_page_offset + pages.total_compressed_size // 2)
    with pytest.raises(ValueError, match=f"{PART} is missing or damaged: .*(CRC|checksum)"):
        Database.open(path).load()


def test_a_missing_part_is_named(path):
    fill(Database.open(path), ["a/1"])
    (path / PART).unlink()
    opened = Database.open(path)
    for use in (opened.load, opened.table, opened.digests, lambda: fill(opened, ["a/2"])):
        with pytest.raises(ValueError, match=PART) as refusal:
            use()
        one_line(refusal)


@pytest.mark.parametrize("length", [0, 4, 1000])
def test_a_truncated_part_is_named(path, length):
    content = (path / PART).read_bytes()
    (path / PART).write_bytes(content[:length])
    with pytest.raises(ValueError, match=f"{PART} is missing or damaged") as refusal:
        Database.open(path).load()
    one_line(refusal)


def test_a_part_of_another_database_is_refused(path, tmp_path):
    """Of other rows, of other descriptors, or only with other numbers."""
    other = fill(Database.create(tmp_path / "other", CONFIG), FRAMES, seed=1)
    (other.path / PART).rename(path / PART)
    with pytest.raises(ValueError, match=f"{PART} is missing or damaged: it"):
        Database.open(path).load()
    fill(Database.create(tmp_path / "few", CONFIG), ["a/1"])
    (tmp_path / "few" / PART).rename(path / PART)
    with pytest.raises(ValueError, match=f"{PART} has 1 rows; the manifest wants 4"):
        Database.open(path).digests()
    narrow = SSRVLADConfig.from_preset("paper", rings=1)
    short = Database.create(tmp_path / "short", narrow)
    short.append([record(frame) for frame in FRAMES], descriptors(0, 4, 96))
    (tmp_path / "short" / PART).rename(path / PART)
    with pytest.raises(ValueError, match=f"{PART} is damaged: its columns"):
        Database.open(path).table(["name", "descriptor"])


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe", b"[]", b"null", b'{"format": "other"}']
)
def test_a_manifest_that_is_none_is_refused(path, content):
    (path / "manifest.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"manifest\.json") as refusal:
        Database.open(path)
    one_line(refusal)


def test_every_changed_digit_of_a_manifest_is_refused(path):
    manifest = path / "manifest.json"
    whole = manifest.read_text()
    positions = [place for place, letter in enumerate(whole) if letter.isdigit()]
    assert len(positions) > 30
    for place in positions:
        other = "2" if whole[place] == "1" else "1"
        manifest.write_text(whole[:place] + other + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"town\.ssrdb"):
            Database.open(path)


def test_another_format_version_is_refused(path):
    edit_manifest(path, format_version=1)
    with pytest.raises(ValueError, match="has database format 1; this version reads 2"):
        Database.open(path)


@pytest.mark.parametrize(
    "name", ["../part-000000.parquet", "/etc/passwd", "part-1.parquet", "part-000000.parquet\n", ""]
)
def test_a_part_outside_the_folder_is_refused(path, name):
    part = {"rows": 4, "bytes": 9, "sha256": ""}
    edit_manifest(path, parts=[{"file": name, **part}])
    with pytest.raises(ValueError, match="names a part"):
        Database.open(path)


# ---- places


def test_a_folder_that_is_no_database_is_refused_and_left_alone(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").touch()
    with pytest.raises(ValueError, match=r"photos is not a database: it has no manifest\.json"):
        Database.open(tmp_path / "photos")
    for make in (Database.create, Database.open_or_create):
        with pytest.raises(ValueError, match="photos is there and is no database"):
            make(tmp_path / "photos", CONFIG)
    assert files(tmp_path / "photos") == ["1.jpg"]


def test_a_file_is_no_database(tmp_path):
    (tmp_path / "file").write_text("precious")
    with pytest.raises(ValueError, match="file is not a database"):
        Database.open(tmp_path / "file")
    for make in (Database.create, Database.open_or_create):
        with pytest.raises(ValueError, match="file is there and is no database"):
            make(tmp_path / "file", CONFIG)
    assert (tmp_path / "file").read_text() == "precious"


def test_a_missing_folder_is_no_database(tmp_path):
    assert not Database.exists(tmp_path / "missing")
    with pytest.raises(ValueError, match="missing is not a database"):
        Database.open(tmp_path / "missing")


def test_a_database_is_not_created_over_one(path):
    with pytest.raises(ValueError, match=r"town\.ssrdb is a database already"):
        Database.create(path, CONFIG)
    assert len(Database.open(path)) == len(FRAMES)


def test_a_folder_in_which_creating_was_killed_can_be_used(tmp_path):
    (tmp_path / "lock").touch()
    (tmp_path / ".manifest.json.4711").write_text("{")
    fill(Database.create(tmp_path, CONFIG), ["a/1"])
    assert len(Database.open(tmp_path)) == 1


def test_a_place_that_cannot_be_written_is_an_oserror(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file") as refusal:
        Database.create(tmp_path / "file" / "db", CONFIG)
    one_line(refusal)


# ---- trouble while writing


def full(*_args, **_settings):
    raise OSError(errno.ENOSPC, "No space left on device")


class HalfFull(io.BufferedWriter):
    """A file on a disk that has room for half of what is written."""

    def write(self, content):
        super().write(content[: len(content) // 2])
        full()


def open_half_full(path, mode="r", **settings):
    return HalfFull(io.FileIO(path, "w")) if mode == "wb" else open(path, mode, **settings)  # noqa: PTH123


def full_at_flush(number):
    """A flush that fails the ``number``-th time it is called."""
    flush, calls = os.fsync, iter(range(100))
    return lambda descriptor: full() if next(calls) == number else flush(descriptor)


TROUBLES = {
    "while the part is written": (Path, "open", open_half_full),
    "while the part is flushed": (os, "fsync", full_at_flush(0)),
    "while the manifest is flushed": (os, "fsync", full_at_flush(2)),
}


@pytest.mark.parametrize("when", TROUBLES)
def test_a_full_disk_leaves_the_database_as_it_was(path, monkeypatch, when):
    whole = Database.open(path).load()
    opened = Database.open(path)
    opened.digests()
    with monkeypatch.context() as patch:
        patch.setattr(*TROUBLES[when])
        with pytest.raises(OSError, match="No space left"):
            fill(opened, ["a/1"])
    assert set(files(path)) - {"part-000001.parquet"} == {"lock", "manifest.json", PART}
    assert len(opened) == len(FRAMES), "nor does the handle count what is not there"
    assert torch.equal(Database.open(path).load().descriptors, whole.descriptors)
    assert len(fill(opened, ["a/1"])) == len(FRAMES) + 1, "the same handle can try again"
    assert Database.open(path).load().frames == ("a/1", *FRAMES)


def test_a_full_disk_leaves_no_half_database(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            Database.create(tmp_path / "db", CONFIG)
    assert not Database.exists(tmp_path / "db")
    assert len(Database.create(tmp_path / "db", CONFIG)) == 0


@pytest.mark.parametrize("whole", [True, False])
def test_a_part_that_the_manifest_does_not_name_is_invisible_and_overwritten(path, tmp_path, whole):
    """A crash between part and manifest."""
    fill(Database.create(tmp_path / "other", CONFIG), ["orphan/1", "orphan/2"])
    orphan = (tmp_path / "other" / PART).read_bytes()
    (path / "part-000001.parquet").write_bytes(orphan if whole else orphan[:100])
    assert Database.open(path).load().frames == FRAMES
    fill(Database.open(path), ["orphan/1"])
    assert Database.open(path).load().frames == (*FRAMES, "orphan/1")


def test_a_crash_at_any_flush_leaves_the_old_rows_or_the_new(path, monkeypatch):
    """What the disk holds is looked at each time that something reaches it."""
    seen, flush = [], os.fsync

    def watch(descriptor):
        seen.append(Database.open(path).load().frames)
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", watch)
    fill(Database.open(path), ["a/1"])
    assert seen == [FRAMES] * 3 + [("a/1", *FRAMES)]


def test_a_second_writer_is_refused_in_one_line(path):
    with Database.open(path).writing():
        with pytest.raises(ValueError, match="is being written by another process") as refusal:
            fill(Database.open(path), ["a/1"])
        one_line(refusal)
        assert len(Database.open(path).load().frames) == len(FRAMES), "readers need no lock"
    assert len(fill(Database.open(path), ["a/1"])) == len(FRAMES) + 1


def test_a_writer_that_is_done_lets_others_write_whoever_shares_its_lock(path):
    """A process forked while it wrote, and not yet so far as to close what it inherited."""
    begun, release = os.pipe(), os.pipe()
    with Database.open(path).writing():
        child = os.fork()
        if child == 0:
            os.write(begun[1], b"1")
            os.read(release[0], 1)
            os._exit(0)
        os.read(begun[0], 1)
    try:
        with Database.open(path).writing():
            pass
    finally:
        os.write(release[1], b"1")
        os.waitpid(child, 0)


def hold_lock(path, held, release):
    with Database.open(path).writing():
        held.set()
        release.wait(30)


def test_the_lock_holds_between_processes_and_ends_with_them(path):
    """Also one that is killed."""
    context = multiprocessing.get_context("spawn")
    held, release = context.Event(), context.Event()
    other = context.Process(target=hold_lock, args=(path, held, release))
    other.start()
    assert held.wait(30)
    with pytest.raises(ValueError, match="is being written by another process"):
        fill(Database.open(path), ["a/1"])
    other.kill()
    other.join(30)
    assert len(fill(Database.open(path), ["a/1"])) == len(FRAMES) + 1


def test_a_database_that_was_made_anew_with_other_settings_is_not_mixed(tmp_path):
    stale = Database.create(tmp_path / "db", CONFIG)
    for entry in (tmp_path / "db").iterdir():
        entry.unlink()
    Database.create(tmp_path / "db", SSRVLADConfig(radius=0.25))
    with pytest.raises(ValueError, match="has fingerprint"):
        fill(stale, ["a/1"])
    assert len(Database.open(tmp_path / "db")) == 0


# ---- replacing and removing


def fill_parts(path):
    """Three parts of four, two and three frames."""
    opened = Database.open(path)
    fill(opened, ["night/0", "day/3"], seed=1)
    fill(opened, ["dawn/5", "dawn/6", "dawn/7"], seed=2)
    return opened


def rows_of(path):
    frames = Database.open(path).load()
    return dict(zip(frames.frames, frames.descriptors.numpy().tolist(), strict=True))


def test_replaced_rows_take_the_place_of_the_old_ones(path):
    opened = fill_parts(path)
    before, order = rows_of(path), Database.open(path).table(["name"])
    numbers = descriptors(7, 2)
    changed = [record("dawn/6", digest="new"), record("day/10", digest="newer", x=3.0)]
    opened.replace(changed, numbers)
    after = rows_of(path)
    assert after.pop("dawn/6") == numbers[0].tolist()
    assert after.pop("day/10") == numbers[1].tolist()
    assert after == {frame: before[frame] for frame in after}
    assert len(Database.open(path)) == len(opened) == 9
    assert Database.open(path).table(["name"]) == order, "their order of addition too"
    assert opened.digests()["dawn/6"] == "new"
    assert Database.open(path).digests() == opened.digests()
    assert fill(opened, ["a/1"]).digests()["day/10"] == "newer"


def test_removed_rows_are_gone(path):
    opened = fill_parts(path)
    before = rows_of(path)
    opened.remove(["day/2", "night/0", "day/3", "never/1"])
    gone = {"day/2", "night/0", "day/3"}
    assert rows_of(path) == {f: row for f, row in before.items() if f not in gone}
    assert len(Database.open(path)) == len(opened) == 6
    assert set(opened.digests()) == set(before) - gone
    fill(opened, ["day/2"], seed=5)
    assert rows_of(path)["day/2"] == descriptors(5, 1)[0].tolist()


def test_removing_all_leaves_an_empty_database(path):
    opened = fill_parts(path)
    opened.remove(list(opened.digests()))
    assert rows_of(path) == {}
    assert len(fill(opened, ["a/1"])) == 1


def test_replacing_what_is_not_there_is_refused(path):
    with pytest.raises(ValueError, match=r"frame 'a/1' is not in .*town\.ssrdb"):
        Database.open(path).replace([record("day/1"), record("a/1")], descriptors(0, 2))
    assert rows_of(path)["day/1"] == descriptors(0, 4)[0].tolist()


def test_one_who_reads_by_the_manifest_of_before_finds_its_parts(path):
    reader = Database.open(path)
    whole = reader.load()
    Database.open(path).replace([record("day/1")], descriptors(9, 1))
    assert torch.equal(reader.load().descriptors, whole.descriptors)


def test_a_number_of_a_part_is_never_given_again(path):
    seen = {part: (path / part).read_bytes() for part in files(path) if part.startswith("part")}
    for number in range(4):
        opened = Database.open(path)
        opened.remove(["night/1"])
        fill(opened, ["night/1"], seed=number)
        for part in files(path):
            if part.startswith("part"):
                assert (
                    seen.setdefault(part, (path / part).read_bytes()) == (path / part).read_bytes()
                )
    assert len(seen) > 4


def test_leftovers_go_with_the_next_writer_and_only_then(path):
    leftovers = [".part-000001.parquet.99.ab", ".manifest.json.99.cd", "part-000007.parquet"]
    for name in leftovers:
        (path / name).write_text("half")
    Database.open(path).load()
    assert set(leftovers) < set(files(path))
    with Database.open(path).writing():
        pass
    assert set(files(path)) == {"lock", "manifest.json", PART}


def test_writers_are_kept_out_for_several_writes(path):
    opened = Database.open(path)
    with opened.writing():
        fill(opened, ["a/1"])
        with pytest.raises(ValueError, match=r"written by another process \(process \d+\); wait"):
            fill(Database.open(path), ["a/2"])
        fill(opened, ["a/3"])
    assert len(fill(Database.open(path), ["a/2"])) == 7


def test_a_failed_flush_of_the_folder_after_the_rename_takes_the_commit_back(path, monkeypatch):
    opened = Database.open(path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full_at_flush(3))
        with pytest.raises(OSError, match="No space left"):
            fill(opened, ["a/1"])
    assert set(Database.open(path).digests()) == set(FRAMES)
    assert len(fill(opened, ["a/1"])) == len(FRAMES) + 1


def test_loading_a_million_would_not_hold_them_twice(tmp_path):
    """The peak of memory beyond the descriptors is that of a part or two."""
    database = Database.create(tmp_path / "db", CONFIG)
    for number in range(12):
        records = [record(f"{number}/{n}") for n in range(1000)]
        database.append(records, descriptors(number, 1000))
    whole = 12_000 * 480 * 4
    tracemalloc.start()
    frames = Database.open(database.path).load(temporal=2)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert frames.descriptors.numel() * 4 == whole
    assert peak < 1.5 * whole + 8e6
