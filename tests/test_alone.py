"""Pictures that are judged alone in a large map, against exact search."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import SPACE
from drives import write_maps
from helpers import descriptors
from large_maps import ALL, CONFIG, ROWS, channels, large_town, queries_at

from ssrvlad_torch import Database, Map
from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.search import alone
from ssrvlad_torch.search.alone import LargeMap, opened_large
from ssrvlad_torch.search.coarse_index import build
from ssrvlad_torch.search.drive import recognise_in_large
from ssrvlad_torch.search.exact import recognise_in
from ssrvlad_torch.search.selection import excluded_pairs

STEPS = Steps(follow=None)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """`ROWS` frames of two drives, one metre apart, with an index."""
    folder = tmp_path_factory.mktemp("alone") / "town.ssrdb"
    return large_town(folder, ["ab"[n % 2] for n in range(ROWS)])


@pytest.mark.parametrize("names", [ALL, ("ssr-vlad",), ("features",), ("features", "hog")])
@pytest.mark.parametrize("sweep", [True, False])
def test_answers_are_those_of_exact_search(town, monkeypatch, names, sweep):
    """Of few candidates; the spread of the scores is that of the whole map, so scores are equal."""
    monkeypatch.setattr(alone, "COARSE", 60)
    monkeypatch.setattr(alone, "EXACT", 30)
    rows, frames, used = [3, 77, 200, 391], town.load(), channels(town, names)
    steps, queries = Steps(follow=None, sweep=sweep), queries_at(rows, names)
    large = LargeMap(town, used)
    got = recognise_in_large(large, queries, steps, 5, np.ones(ROWS, bool))
    numbers = [recognise_in_each(frames, queries, used, steps, n) for n in range(len(rows))]
    first = torch.cat([each.matches.indices[:, 0] for each in numbers])
    assert torch.equal(got.matches.indices[:, 0], first)
    assert [large.frames.frames[row] for row in first.tolist()] == [
        f"{'ab'[row % 2]}/{row:03d}" for row in rows
    ]
    best = torch.cat([each.matches.scores[:, 0] for each in numbers])
    torch.testing.assert_close(got.matches.scores[:, 0], best, atol=2e-3, rtol=0)
    widths = [each.used["sweep"]["today"] for each in numbers]
    assert got.used["sweep"]["today"] == max(widths)
    assert got.used["weights"]["today"] == numbers[0].used["weights"]["today"]
    assert got.used["references"] == ROWS and got.used["follow"] == {"today": "no"}


def test_without_the_core_confidence_is_the_same(town, core, monkeypatch):
    """Only candidates have scores, but every row is a place that could match."""
    where = np.arange(ROWS) % 2 == 0
    large, queries = LargeMap(town, channels(town, ALL)), queries_at([4, 78, 200, 390], ALL)
    fast = [recognise_in_large(large, queries, STEPS, 5, each) for each in (where, where | True)]
    monkeypatch.setattr("ssrvlad_torch.recognition.deciding.has_core", lambda: False)
    plain = [recognise_in_large(large, queries, STEPS, 5, each) for each in (where, where | True)]
    for ours, theirs in zip(plain, fast, strict=True):
        assert torch.equal(ours.matches.indices, theirs.matches.indices)
        assert theirs.confidence.max() > 0.5
        torch.testing.assert_close(ours.confidence, theirs.confidence, atol=1e-4, rtol=0)


def recognise_in_each(frames, queries, used, steps, number):
    """Exact search of one query alone."""
    some = {name: values[number : number + 1] for name, values in queries.channels.items()}
    of_one = queries.frames[number : number + 1]
    one = replace(queries, frames=of_one, sequences=("today",), channels=some)
    return recognise_in(frames, one, used, steps, 5)


def test_confidence_is_that_of_exact_search(town):
    rows, frames, used = [*range(5, 25)], town.load(), channels(town, ALL)
    queries = queries_at(rows)
    got = recognise_in_large(LargeMap(town, used), queries, STEPS, 5, np.ones(ROWS, bool))
    expected = recognise_in(frames, queries, used, STEPS, 5)
    torch.testing.assert_close(got.confidence, expected.confidence, atol=0.05, rtol=0)
    assert torch.equal(got.matches.indices[:, 0], expected.matches.indices[:, 0])


def test_candidates_are_among_the_allowed_rows_and_no_neighbours(town):
    used, frames = channels(town, ALL), town.load()
    queries, where = queries_at([30, 31]), np.zeros(ROWS, bool)
    where[100:120] = True
    large = LargeMap(town, used)
    got = recognise_in_large(large, queries, STEPS, 50, where).matches
    assert {*got.indices[got.indices >= 0].tolist()} == {*range(100, 120)}
    assert bool((got.indices[:, 20:] == -1).all())
    again = replace(queries, frames=("a/030", "b/031"), sequences=("a", "b"))
    whole = np.ones(ROWS, bool)
    near = recognise_in_large(large, again, STEPS, 50, whole, exclude=3).matches.indices
    excluded = excluded_pairs(again, frames, whole, 3)
    assert not bool(excluded.gather(1, near).any())


def test_only_large_maps_are_searched_by_their_index(town, tmp_path, monkeypatch):
    used = channels(town, ALL)
    assert opened_large(town, used) == ""
    monkeypatch.setattr(alone, "LEAST_ROWS", ROWS)
    assert isinstance(opened_large(town, used), LargeMap)
    bare = Database.create(tmp_path / "bare", CONFIG)
    bare.append([f"a/{n:03d}" for n in range(ROWS)], descriptors(0, ROWS))
    assert opened_large(bare, channels(bare, ALL)) == ""
    build(bare)
    bare.append(["a/999"], descriptors(1, 1))
    assert "lacks 1 of 401 frames" in opened_large(bare, channels(bare, ALL))


def test_commands_and_maps_take_the_index_by_themselves_and_say_so(ssrvlad, tmp_path, monkeypatch):
    monkeypatch.setattr(alone, "LEAST_ROWS", 40)
    maps, path = write_maps(tmp_path / "monday", range(40)), tmp_path / "drawn.ssrdb"
    rows = [f"monday/{n:03d},{n},0,0" for n in range(40)]
    (tmp_path / "poses.csv").write_text("\n".join(["frame,x,y,heading", *rows]))
    town = Map.open(path, labels_as=SPACE)
    town.add(maps)
    build(town.database)
    monkeypatch.setattr(Database, "load", None)
    picture = sorted(maps.glob("*"))[7]
    said = "candidates of the index, not standardised"
    code, out, err = ssrvlad("query", path, picture, "--top", 1)
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
    monkeypatch.setattr(alone, "LEAST_ROWS", 40)
    town.database.append(["late/0"], descriptors(0, 1))
    *_, line = ssrvlad("query", path, picture)[2]
    assert "lacks 1 of 41 frames; ssrvlad db index adds them" in line
