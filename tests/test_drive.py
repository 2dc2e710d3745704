"""Drives in a large map, against exact search."""

import dataclasses

import numpy as np
import pytest
import torch
from drives import write_maps
from helpers import spoil
from large_maps import ALL, ROWS, channels, large_town, queries_at
from loop_streams import objects

from ssrvlad_torch import Database, Map
from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.search import alone, drive
from ssrvlad_torch.search.alone import LargeMap
from ssrvlad_torch.search.coarse_index import build
from ssrvlad_torch.search.drive import DriveSearch, recognise_in_large
from ssrvlad_torch.search.exact import recognise_in
from ssrvlad_torch.search.map_rows import MapRows
from ssrvlad_torch.search.selection import excluded_pairs, select

EVERYWHERE = np.ones(ROWS, bool)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Two drives, and folders of 20 frames."""
    folders = [f"c{n:02d}" for n in range(5) for _ in range(20)]
    return large_town(
        tmp_path_factory.mktemp("drive") / "town.ssrdb", ["a"] * 180 + ["b"] * 120 + folders
    )


@pytest.fixture
def whole(monkeypatch):
    """All rows are candidates of every query."""
    monkeypatch.setattr(drive, "CANDIDATES", ROWS)
    monkeypatch.setattr(drive, "EVERY", 1)


def found_in(town, queries, steps, names=ALL):
    """What is recognised by the index, and by exact search."""
    used, where = channels(town, names), np.ones(len(town), bool)
    exact = recognise_in(town.load(), queries, used, steps, 3)
    return recognise_in_large(LargeMap(town, used), queries, steps, 3, where), exact


@pytest.mark.parametrize("names", [ALL, ("ssr-vlad",), ("features", "hog")])
@pytest.mark.parametrize(
    "steps",
    [
        Steps(),
        Steps(follow="online", delay=2),
        Steps(follow=None),
        Steps(standardise=False, sweep=False),
    ],
)
@pytest.mark.usefixtures("whole")
def test_of_all_rows_answers_are_those_of_exact_search(town, names, steps):
    got, expected = found_in(town, queries_at([*range(100, 140)], names), steps, names)
    assert torch.equal(got.matches.indices, expected.matches.indices)
    torch.testing.assert_close(got.matches.scores, expected.matches.scores, atol=1e-5, rtol=0)
    torch.testing.assert_close(got.confidence, expected.confidence, atol=1e-4, rtol=0)
    for step in ("standardise", "sweep", "follow", "references"):
        assert got.used[step] == expected.used[step]
    assert got.used["weights"]["today"] == pytest.approx(
        expected.used["weights"]["today"], abs=1e-4
    )


@pytest.mark.parametrize("rows", [range(100, 145), range(290, 312), range(240, 200, -1)])
def test_of_few_candidates_the_first_answers_are_the_same(town, rows):
    got, expected = found_in(town, queries_at([*rows]), Steps())
    assert torch.equal(got.matches.indices[:, 0], expected.matches.indices[:, 0])
    assert got.used["follow"] == expected.used["follow"]
    torch.testing.assert_close(got.confidence, expected.confidence, atol=0.1, rtol=0)


@pytest.mark.parametrize(("count", "most"), [(128, 33), (70, 36), (40, 40)])
def test_only_some_queries_of_a_followed_drive_are_compared_with_all_rows(
    town, monkeypatch, count, most
):
    """Those that show the width of the sweep are among them; none is compared twice."""
    compared, scanned = [], drive.DriveSearch._scanned

    def note(search, some, given):
        compared.extend(some.tolist())
        return scanned(search, some, given)

    monkeypatch.setattr(drive.DriveSearch, "_scanned", note)
    used, queries = channels(town, ALL), queries_at([*range(100, 100 + count)])
    large = LargeMap(town, used)
    recognise_in_large(large, queries, Steps(), 3, EVERYWHERE)
    assert len(compared) == len({*compared}) <= most
    compared.clear()
    recognise_in_large(large, queries, Steps(follow=None), 3, EVERYWHERE)
    assert sorted(compared) == [*range(count)]


@pytest.mark.usefixtures("whole")
def test_rows_that_may_not_match_are_no_candidates_and_have_no_score(town):
    used, frames = channels(town, ALL), town.load()
    where, queries = select(frames, ["a"]), queries_at([*range(100, 140)])
    ids = tuple(f"a/{row:03d}" for row in range(100, 140))
    again = dataclasses.replace(queries, frames=ids, sequences=("a",) * 40)
    got = recognise_in_large(LargeMap(town, used), again, Steps(), 3, where, exclude=4)
    without = excluded_pairs(again, frames, where, 4)
    expected = recognise_in(frames, again, used, Steps(), 3, without)
    assert torch.equal(got.matches.indices, expected.matches.indices)
    large, own = LargeMap(town, used), np.array([[96, 105]] * 40)
    given = again.channels, True, True, True, 3, where, own
    search = DriveSearch(large, MapRows(large), *given)
    rows = torch.tensor([3, 100, 179, 180])
    assert search.scores(7, rows).isinf().tolist() == [False, True, False, True]
    assert {*search.candidates(7).tolist()} <= {*range(96), *range(105, 180)}


@pytest.mark.parametrize("allowed", [range(399, 400), range(110, 130), range(0, 400, 20)])
@pytest.mark.parametrize("names", [ALL, ("ssr-vlad",)])
def test_few_rows_that_may_match_are_found(town, allowed, names):
    """Whatever rows are in a sample of the map."""
    where = np.zeros(ROWS, bool)
    where[[*allowed]] = True
    used, frames = channels(town, names), town.load()
    queries = queries_at([*range(100, 140)], names)
    got = recognise_in_large(LargeMap(town, used), queries, Steps(follow=None), 3, where)
    without = excluded_pairs(queries, frames, where, None)
    expected = recognise_in(frames, queries, used, Steps(follow=None), 3, without)
    assert (got.matches.indices[:, 0] == expected.matches.indices[:, 0]).float().mean() > 0.9
    torch.testing.assert_close(got.confidence, expected.confidence, atol=0.05, rtol=0)


def test_as_many_candidates_as_are_wanted(town):
    used, queries = channels(town, ALL), queries_at([*range(100, 140)])
    got = recognise_in_large(LargeMap(town, used), queries, Steps(follow=None), 100, EVERYWHERE)
    assert bool((got.matches.indices >= 0).all())


@pytest.mark.usefixtures("whole")
def test_sequences_in_several_data_files_and_without_removed_frames(tmp_path):
    """The means are those of the frames that are there."""
    town = large_town(tmp_path / "town.ssrdb", ["a"] * 200 + ["b"] * 200)
    frames = town.load()
    town.remove([frames.frames[row] for row in range(60, 90)])
    build(town)
    got, expected = found_in(town, queries_at([*range(100, 140)]), Steps())
    assert torch.equal(got.matches.indices, expected.matches.indices)
    torch.testing.assert_close(got.confidence, expected.confidence, atol=1e-4, rtol=0)


def test_damaged_rows_are_refused(tmp_path):
    town = large_town(tmp_path / "town.ssrdb", ["a"] * ROWS)
    spoil(tmp_path / "town.ssrdb", town.load().descriptors[120])
    again = Database.open(tmp_path / "town.ssrdb")
    large, queries = LargeMap(again, channels(again, ALL)), queries_at([*range(100, 140)])
    with pytest.raises(ValueError, match=r"is damaged; ssrvlad db verify shows where"):
        recognise_in_large(large, queries, Steps(), 3, EVERYWHERE)


def test_empty_queries_and_few_of_them_have_an_answer_or_none(town):
    used, queries = channels(town, ("ssr-vlad",)), queries_at([5, 6, 7], ("ssr-vlad",))
    queries.channels["ssr-vlad"][1] = 0
    got = recognise_in_large(LargeMap(town, used), queries, Steps(follow=None), 3, EVERYWHERE)
    assert got.matches.indices[:, 0].tolist() == [5, -1, 7]
    assert got.used["follow"] == {"today": "no"} and got.used["standardise"] == {"today": False}


def test_a_command_takes_the_index_for_a_drive_and_says_so(ssrvlad, tmp_path, monkeypatch):
    monkeypatch.setattr(alone, "LEAST_ROWS", 40)
    maps, path = write_maps(tmp_path / "monday", range(40)), tmp_path / "drawn.ssrdb"
    town = Map.open(path, labels_as="camvid-11")
    town.add(maps)
    build(town.database)
    some = write_maps(tmp_path / "today", range(3, 38))
    _, out, _ = ssrvlad("query", path, some, "--json")
    exact = objects(out)
    monkeypatch.setattr(Database, "load", None)
    code, out, err = ssrvlad("query", path, some, "--json")
    found = objects(out)
    assert code == 0 and found[0]["steps"]["index"] == "candidates of the index"
    assert not err
    for one, other in zip(found, exact, strict=True):
        assert one["candidates"][0]["frame"] == other["candidates"][0]["frame"]
