"""Large maps: the index of their rows, and a shortlist of them against exact search."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from drawings import SPACE
from helpers import descriptors, refuses, spoil, write_maps

from ssrvlad_torch import SSRVLAD, Database, Map, SSRVLADConfig
from ssrvlad_torch.channels import Column
from ssrvlad_torch.channels.channel import channels_of
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.database.engine import open_table
from ssrvlad_torch.database.frames import FrameRecord, FrameSet
from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.search import exact, shortlist
from ssrvlad_torch.search.exact import open_shortlist, recognise_in
from ssrvlad_torch.search.index import Index, MapRows, build, damaged, read_rows
from ssrvlad_torch.search.selection import neighbours, select
from ssrvlad_torch.search.shortlist import Shortlist
from ssrvlad_torch.stages.features import FORM

CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)
ROWS = 400
ALL = ("ssr-vlad", "features", "hog")


def noisy(numbers, seed, noise):
    return F.normalize(numbers + noise * descriptors(seed, len(numbers)), dim=1)


def flipped(signs, seed, share):
    bits = np.random.default_rng(seed).random((*signs.shape, 8)) < share
    return signs ^ torch.from_numpy(np.packbits(bits, axis=-1)[..., 0])


def places():
    """Descriptors of `ROWS` places by three channels."""
    shape = Features(FORM).column.shape
    signs = np.random.default_rng(0).integers(0, 256, (ROWS, *shape), np.uint8)
    return {
        "ssr-vlad": descriptors(0, ROWS),
        "features": torch.from_numpy(signs),
        "hog": descriptors(1, ROWS).abs(),
    }


def seen(rows):
    """Other views of some places; label maps are described from all anchors."""
    known = {name: values[rows] for name, values in places().items()}
    swept = [noisy(known["ssr-vlad"], 10 + n, 0.5 + abs(c) / 8) for n, c in enumerate(COLUMNS)]
    return {
        "ssr-vlad": torch.stack(swept, 1),
        "features": flipped(known["features"], 3, 0.35),
        "hog": noisy(known["hog"], 4, 0.8),
    }


def queries_at(rows, names=ALL):
    count, unknown = len(rows), np.full((len(rows), 3), np.nan)
    ids = tuple(f"today/{n:03d}" for n in range(count))
    channels = {name: values for name, values in seen(rows).items() if name in names}
    return FrameSet(ids, ("today",) * count, channels, unknown, unknown[:, 0], unknown[:, 0] > 0)


def large_town(path, sequences):
    """`ROWS` frames of drives, one metre apart, with an index."""
    columns = [Features(FORM).column, HOG().column]
    database = Database.create(path, CONFIG, columns=columns)
    frames = [FrameRecord(name, f"{n:03d}", float(n), 0.0) for n, name in enumerate(sequences)]
    database.append(frames, places())
    build(database)
    return database


def channels(town, names):
    return channels_of([c for c in town.columns if c.name in names], SSRVLAD(CONFIG))


ALONE = Steps(follow=None)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Two sequences, and folders of 20 frames."""
    folders = [f"c{n:02d}" for n in range(5) for _ in range(20)]
    path = tmp_path_factory.mktemp("large") / "town.ssrdb"
    return large_town(path, ["a"] * 180 + ["b"] * 120 + folders)


@pytest.fixture
def few(monkeypatch):
    """A fifth of the rows is read."""
    for name, value in (("MOST", 20), ("LEAST", 3), ("ROWS", 60), ("SAMPLE", 50)):
        monkeypatch.setattr(shortlist, name, value)


def both(town, queries, steps, names=ALL, **masks):
    """What is recognised by a shortlist, and by exact search."""
    used = channels(town, names)
    return (
        recognise_in(references, queries, used, steps, 3, **masks)
        for references in (Shortlist(town, used), town.load())
    )


def first(recognised):
    return recognised.matches.indices[:, 0].tolist()


@pytest.mark.parametrize("names", [ALL, ("ssr-vlad",), ("features", "hog")])
@pytest.mark.parametrize("sweep", [True, False])
@pytest.mark.usefixtures("few")
def test_a_picture_has_the_answer_of_exact_search(town, names, sweep):
    for row in (3, 77, 200, 391):
        steps = Steps(follow=None, sweep=sweep)
        short, exact = both(town, queries_at([row], names), steps, names)
        assert first(short) == first(exact) == [row]
        near = short.matches.scores[0, 0], exact.matches.scores[0, 0]
        torch.testing.assert_close(*near, atol=0.05, rtol=0)
        assert short.used["references"] == ROWS


STEPS = [Steps(), Steps(follow="online", delay=2), ALONE, Steps(standardise=False, sweep=False)]


@pytest.mark.parametrize("names", [ALL, ("ssr-vlad",), ("features", "hog")])
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.usefixtures("few")
def test_a_sequence_has_the_places_and_confidence_of_exact_search(town, names, steps):
    short, exact = both(town, queries_at([*range(100, 140)], names), steps, names)
    apart = np.abs(np.subtract(first(short), first(exact)))
    assert (apart <= 2).mean() == 1 if steps.follow else (apart == 0).mean() > 0.9
    assert (short.confidence - exact.confidence).abs().mean() < 0.05
    assert short.used["follow"] == exact.used["follow"]
    for name, weight in exact.used["weights"]["today"].items():
        assert short.used["weights"]["today"][name] == pytest.approx(weight, abs=0.1)


@pytest.mark.usefixtures("few")
def test_rows_that_may_not_match_are_no_candidates(town):
    frames = town.load()
    ids = tuple(f"a/{row:03d}" for row in range(100, 140))
    queries = replace(queries_at([*range(100, 140)]), frames=ids, sequences=("a",) * 40)
    masks = {"where": select(frames, ["a"]), "excluded": neighbours(ids, frames, 4)}
    short, _ = both(town, queries, Steps(), **masks)
    rows, (begin, end) = short.matches.indices.numpy(), masks["excluded"].T[..., None]
    assert (rows < 180).all() and not ((rows >= begin) & (rows < end)).any()


@pytest.mark.parametrize("allowed", [range(399, 400), range(110, 130), range(0, 400, 20)])
@pytest.mark.usefixtures("few")
def test_few_rows_that_may_match_are_found(town, allowed):
    where = np.isin(np.arange(ROWS), allowed)
    short, exact = both(town, queries_at([*range(100, 140)]), ALONE, where=where)
    is_there, same = where[100:140], np.equal(first(short), first(exact))
    assert same[is_there].all() and same.mean() > 0.8
    torch.testing.assert_close(short.confidence, exact.confidence, atol=0.05, rtol=0)


def test_means_are_of_the_frames_that_are_there(tmp_path, monkeypatch):
    """Without removed frames; short sequences have one together, and too few frames that of all.
    Where all rows are read, and all make the means, answers are those of exact search."""
    monkeypatch.setattr(shortlist, "MEAN_ROWS", 400)
    names = ["a"] * 200 + ["b"] * 20 + ["c"] * 20 + ["d"] * 150 + ["e"] * 10
    town = large_town(tmp_path / "town.ssrdb", names)
    town.remove([f"a/{row:03d}" for row in range(60, 90)])
    build(town)
    short, exact = both(town, queries_at([*range(100, 140)]), Steps())
    assert torch.equal(short.matches.indices, exact.matches.indices)
    torch.testing.assert_close(short.confidence, exact.confidence, atol=1e-4, rtol=0)


def test_damaged_rows_are_refused(tmp_path):
    town = large_town(tmp_path / "town.ssrdb", ["a"] * ROWS)
    spoil(tmp_path / "town.ssrdb", town.load().descriptors[120])
    again = Database.open(tmp_path / "town.ssrdb")
    with pytest.raises(ValueError, match=r"is damaged; ssrvlad db verify shows where"):
        Shortlist(again, channels(again, ALL))


def test_only_large_maps_with_an_index_have_a_shortlist(town, tmp_path, monkeypatch):
    used = channels(town, ALL)
    assert open_shortlist(town, used) == (None, "")
    monkeypatch.setattr(exact, "LEAST_ROWS", ROWS)
    assert isinstance(open_shortlist(town, used)[0], Shortlist)
    bare = Database.create(tmp_path / "bare", CONFIG)
    bare.append([f"a/{n:03d}" for n in range(ROWS)], descriptors(0, ROWS))
    assert open_shortlist(bare, channels(bare, ALL)) == (None, "")
    build(bare)
    bare.append(["a/999"], descriptors(1, 1))
    assert "lacks 1 of 401 frames" in open_shortlist(bare, channels(bare, ALL))[1]


def test_commands_and_maps_take_the_index_by_themselves_and_say_so(ssrvlad, tmp_path, monkeypatch):
    monkeypatch.setattr(exact, "LEAST_ROWS", 40)
    maps, path = write_maps(tmp_path / "monday", range(40)), tmp_path / "drawn.ssrdb"
    rows = [f"monday/{n:03d},{n},0,0" for n in range(40)]
    (tmp_path / "poses.csv").write_text("\n".join(["frame,x,y,heading", *rows]))
    town = Map.open(path, labels_as=SPACE)
    town.add(maps)
    build(town.database)
    monkeypatch.setattr(Database, "load", None)
    picture = sorted(maps.glob("*"))[7]
    said = "candidates of the index, not standardised"
    code, out, err = ssrvlad("query", path, picture, "--top", 1, "--verbose")
    assert code == 0 and out.split()[:2] == ["monday/007:", "monday/007"] and said in err[-1]
    some = write_maps(tmp_path / "today", range(29))
    _, out, err = ssrvlad("query", path, some, "--follow", "no", "--json")
    firsts = [json.loads(line)["candidates"][0]["frame"] for line in out.splitlines()]
    assert firsts == [f"monday/{n:03d}" for n in range(29)]
    near = ssrvlad("query", path, picture, "--near", "20,0,3")[1]
    assert "monday/007 " not in near and "monday/02" in near
    (tmp_path / "today" / "poses.csv").write_text(
        "\n".join(["frame,x,y", *(f"{n:03d},{n},0" for n in range(29))])
    )
    steps = ("--follow", "no", "--tolerance-metres", 1, "--json")
    report = ("--report", tmp_path / "page.html")
    found = json.loads(ssrvlad("evaluate", path, some, *steps, *report)[1])
    assert found["recall_at"]["1"] == 1 and Path(tmp_path, "page.html").exists()
    monkeypatch.undo()
    monkeypatch.setattr(exact, "LEAST_ROWS", 40)
    town.database.append(["late/0"], descriptors(0, 1))
    lines = ssrvlad("query", path, picture, "--verbose")[2]
    assert any("lacks 1 of 41 frames; ssrvlad db index adds them" in line for line in lines)


# ---- the index of a large map: codes of all rows, grown, opened, refused


SIGNS = Column("signs", "few", (4, 2, 4), "uint8")


def rows(first, count):
    """Descriptors by two channels."""
    signs = np.random.default_rng(first).integers(0, 256, (count, *SIGNS.shape), np.uint8)
    return {"ssr-vlad": descriptors(first, count), "signs": torch.from_numpy(signs)}


def add(database, first, count):
    database.append([f"a/{first + n:04d}" for n in range(count)], rows(first, count))


def opened(database):
    index = Index(database, MapRows.of(database))
    return index, index.codes()


@pytest.fixture
def indexed(tmp_path):
    """100 frames by two channels."""
    database = Database.create(tmp_path / "town.ssrdb", CONFIG, columns=[SIGNS])
    add(database, 0, 100)
    return database


def assert_own_row_is_first(database, frame, query):
    """That of all rows the one that equals a query has its highest score by every channel."""
    index, codes = opened(database)
    for name, values in query.items():
        [scores] = index.coders[name].scores(values[:1], codes[name], False)
        assert len(scores) == len(database)
        assert index.rows.frames.frames[int(scores.argmax())] == frame


def test_every_row_has_its_code_also_after_changes_of_the_map(indexed):
    report = build(indexed)
    assert (report.new, report.frames) == (100, 100) and report.bytes > 100 * 64
    assert_own_row_is_first(indexed, "a/0000", rows(0, 1))
    add(indexed, 100, 70)
    refuses("lacks 70 of 170 frames; ssrvlad db index adds them", opened, indexed)
    assert build(indexed).new == 70
    assert_own_row_is_first(indexed, "a/0100", rows(100, 1))
    indexed.remove(["a/0003", "a/0100"])
    assert build(indexed)[:2] == (0, 168)
    indexed.merge(["a/0000"], rows(500, 1))
    assert build(indexed).new == 1
    assert_own_row_is_first(indexed, "a/0000", rows(500, 1))
    indexed.compact(keep_days=0)
    assert build(indexed).new == 0
    assert_own_row_is_first(indexed, "a/0000", rows(500, 1))


def test_codes_that_no_frame_has_are_dropped_when_they_are_most(indexed):
    """Changed poses change all checksums."""
    build(indexed)
    sizes = []
    for seed in (1000, 2000, 3000):
        indexed.merge([f"a/{n:04d}" for n in range(100)], rows(seed, 100))
        build(indexed)
        sizes.append(open_table(str(Path(indexed.path, "_index", "codes"))).count_rows())
    assert sizes == [200, 100, 200]
    assert_own_row_is_first(indexed, "a/0000", rows(3000, 1))


def test_rows_of_a_version_that_was_deleted_since_are_no_damage(indexed):
    reader = Database.open(indexed.path)
    add(indexed, 100, 1)
    indexed.compact(keep_days=0)
    message = "was deleted since: open it again"
    refuses(message, read_rows, reader, np.arange(2), [SIGNS])


def test_what_cannot_be_opened_or_built_is_refused_in_one_line(indexed, tmp_path):
    refuses("has no index; ssrvlad db index builds one", opened, indexed)
    refuses("holds no frames yet", build, Database.create(tmp_path / "empty", CONFIG))

    build(indexed)
    spoil(Path(indexed.path), rows(0, 3)["ssr-vlad"][2])
    add(indexed, 100, 1)
    assert build(Database.open(indexed.path)).new == 1, "what is indexed is not read again"
    Path(indexed.path, "_index", "learnt.npz").unlink()
    refuses("is damaged; ssrvlad db verify shows where", build, Database.open(indexed.path))


def test_an_index_of_other_channels_is_built_anew(indexed, tmp_path):
    build(indexed)
    other = Database.create(tmp_path / "other.ssrdb", CONFIG)
    other.append(["a/0"], descriptors(0, 1))
    Path(indexed.path, "_index").rename(Path(other.path, "_index"))
    refuses("of other channels or another version; ssrvlad db index builds", opened, other)
    assert build(other).new == 1


@pytest.mark.parametrize("name", ["codes/data/*.lance", "learnt.npz"])
@pytest.mark.parametrize("keep", [None, 20, 0])
def test_every_file_of_the_index_is_checked_and_mended(indexed, name, keep):
    build(indexed)
    assert damaged(indexed) == []
    [file] = Path(indexed.path, "_index").glob(name)
    content = file.read_bytes()
    middle = len(content) // 2
    turned = content[:middle] + bytes(255 - byte for byte in content[middle:][:64])
    file.write_bytes(content[:keep] if keep is not None else turned + content[middle + 64 :])
    assert damaged(indexed) == [f"_index/{name.split('/')[0]}"]
    build(indexed)
    assert damaged(indexed) == []
    assert_own_row_is_first(indexed, "a/0000", rows(0, 1))


def test_a_map_keeps_its_index_complete(tmp_path):
    indexed = Map.open(tmp_path / "drawn.ssrdb", labels_as=SPACE)
    indexed.add(write_maps(tmp_path / "monday", range(6)))
    assert not Path(indexed.path, "_index").exists(), "only db index makes one"
    build(indexed.database)
    indexed.add(write_maps(tmp_path / "tuesday", range(3)))
    opened(indexed.database)
