"""An index on disk against exact search."""

import pytest
import torch
import torch.nn.functional as F
from helpers import descriptors, spoil

from ssrvlad_torch import Database, match
from ssrvlad_torch.recognition.comparison import Member, ReferenceRows
from ssrvlad_torch.recognition.recognise import Steps, recognise, recognise_by_search
from ssrvlad_torch.recognition.standardise import standardise
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.search import index_search
from ssrvlad_torch.search.index import build_index, search_index
from ssrvlad_torch.search.index_search import IndexSearch


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """600 frames of 100 places, one of them empty, with an index of the first 500."""
    database = Database.create(tmp_path_factory.mktemp("index") / "db", width=32)
    places = descriptors(0, 100, 32).repeat(6, 1) + 0.3 * descriptors(1, 600, 32)
    places[7] = 0
    frames = [f"{'ab'[n % 2]}'s/{n:03d}" for n in range(600)]
    database.append(frames[:500], places[:500])
    report = build_index(database)
    database.append(frames[500:], places[500:])
    database.remove([frames[20]])
    return database, report


def test_the_report_compares_with_exact_search(town):
    assert min(town[1].recall_at[n] for n in (1, 10)) >= 0.9


def indexed(folder, places):
    """A database of these descriptors with an index, and the report."""
    database = Database.create(folder / "db", width=places.shape[1])
    database.append([f"a/{n:03d}" for n in range(len(places))], places)
    return database, build_index(database)


def test_equal_frames_count_alike_in_the_recall(tmp_path):
    assert indexed(tmp_path, descriptors(0, 20, 32).repeat(20, 1))[1].recall_at[1] == 1


def test_scores_are_exact_and_frames_added_later_are_found(town):
    frames = town[0].load()
    queries = frames.descriptors[1::13]
    expected = match(queries, frames.descriptors, 3)
    for ours, rows, scores in zip(search_index(town[0], queries, 3), *expected[::-1], strict=True):
        theirs = {frames.frames[r]: float(s) for r, s in zip(rows.tolist(), scores, strict=True)}
        assert ours[0][0] == next(iter(theirs))
        assert all(theirs.get(frame, score) == pytest.approx(score) for frame, score in ours)
    later = [frame for frame in frames.frames if int(frame[-3:]) >= 500][:5]
    rows = [frames.frames.index(frame) for frame in later]
    best = search_index(town[0], frames.descriptors[rows], 1)
    assert [candidates[0][0] for candidates in best] == later


def test_candidates_can_be_of_some_sequences(town):
    database, _ = town
    frames = database.load()
    query = frames.descriptors[frames.frames.index("a's/040")][None]
    [found] = search_index(database, query, 20, sequences=["b's"])
    assert [frame[0] for frame, _ in found] == ["b"] * 20
    assert search_index(database, torch.zeros(1, 32)) == [[]]


def test_replaced_frames_are_found_by_their_new_descriptor_also_after_compacting(town):
    database, _ = town
    new = descriptors(9, 1, 32)
    database.merge(["a's/000"], new)
    assert search_index(database, new, 1)[0][0][0] == "a's/000"
    database.compact()
    assert search_index(database, new, 1)[0][0][0] == "a's/000"
    assert "a's/020" not in dict(search_index(database, new, 599)[0])


def test_too_few_frames_for_an_index_and_damaged_rows_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 256 frames"):
        indexed(tmp_path, descriptors(0, 20, 9))
    database, numbers = Database.open(tmp_path / "db"), descriptors(1, 300, 9)
    with pytest.raises(ValueError, match="has no index; ssrvlad db index builds one"):
        search_index(database, numbers)
    database.append([f"b/{n}" for n in range(300)], numbers)
    build_index(database)
    spoil(tmp_path / "db", numbers[5])
    with pytest.raises(ValueError, match="is damaged"):
        search_index(Database.open(tmp_path / "db"), numbers[5][None], 1)


@pytest.mark.parametrize("follow", ["offline", "online", None])
@pytest.mark.parametrize("off", [True, False])
def test_with_all_frames_as_candidates_results_equal_exact_search(town, monkeypatch, follow, off):
    database, _ = town
    monkeypatch.setattr(index_search, "CANDIDATES", 1000)
    frames = database.load()
    queries = F.normalize(frames.descriptors[300:340] + 0.3 * descriptors(5, 40, 32), dim=1)
    queries[11] = 0
    steps = Steps(standardise=off, sweep=False, follow=follow)
    names = ["q"] * 40
    known = ReferenceRows(frames.descriptors, frames.sequences)
    member = {"ssr-vlad": Member(queries, known)}
    expected = recognise(member, names, frames.sequences, steps, 3)

    def search(standardised: bool) -> IndexSearch:
        return IndexSearch(database, queries, names, standardised)

    got = recognise_by_search(search, names, frames.sequences, steps, 3)
    assert got.used == {**expected.used, "sweep": {"q": 0}}
    assert torch.equal(got.matches.indices, expected.matches.indices)
    torch.testing.assert_close(got.matches.scores, expected.matches.scores, atol=1e-4, rtol=0)
    torch.testing.assert_close(got.confidence, expected.confidence, atol=5e-3, rtol=0)


def test_scores_of_any_row_are_exact(town):
    database, _ = town
    frames = database.load()
    queries = frames.descriptors[::50]
    ids = ["a's/013"] * len(queries)
    search = IndexSearch(database, queries, ["q"] * len(queries), True, ["a's"], (ids, 2))
    exact = score(standardise(queries), standardise(frames.descriptors, frames.sequences))
    rows = torch.tensor([3, 6, 100, 290])
    expected = exact[2, rows]
    expected[1] = -torch.inf
    torch.testing.assert_close(search.scores(2, rows), expected)
    assert all(frames.sequences[row] == "a's" for row in search.candidates(2).tolist())
    excluded = ["a's/300"] * len(queries), 140  # all but 18 of the 299 frames
    search = IndexSearch(database, queries, ["q"] * len(queries), True, ["a's"], excluded)
    assert [len(search.candidates(query)) for query in (2, 5)] == [18, 18]
    with pytest.raises(ValueError, match="no sequence 'c'"):
        IndexSearch(database, queries, ["q"] * len(queries), allowed=["c"])
