"""`ssrvlad query`."""

import json

import pytest
from drives import write_maps

from ssrvlad_torch.cli.words import by_sequence


def test_more_candidates_than_references_give_all_references(ssrvlad, database, maps):
    """What would not fit in memory is never allocated."""
    code, out, _ = ssrvlad("query", database, maps, "--top", 10**12, "--json")
    assert code == 0
    assert {len(json.loads(line)["candidates"]) for line in out.splitlines()} == {6}


def test_the_steps_are_taken_and_reported(ssrvlad, database, maps):
    steps = ("--no-standardise", "--no-sweep", "--follow", "no")
    _, out, err = ssrvlad("query", database, maps, "--top", 1, *steps)
    ends = [line.split()[-4:] for line in out.splitlines()]
    assert ends == [["1.0000", "(cosine,", "confidence", "0.00)"]] * 6
    assert "not standardised, no sweep, followed: no, no temporal sum" in err[-1]
    sure = json.loads(ssrvlad("query", database, maps, "--json")[1].splitlines()[0])
    assert sure["confidence"] == 0 and sure["steps"]["standardise"] == {"monday": False}
    assert "6 references are too few" in err[-1]
    _, followed, err = ssrvlad("query", database, maps)
    assert "followed: no, no surer so" in err[-1] and "(cosine, confidence" in followed
    assert sure["score_is"] == "cosine"
    nothing = ssrvlad("query", database, maps, "--min-confidence", 1)[1].splitlines()
    assert all("no candidate" in line for line in nothing)
    assert "temporal sum t = 3" in ssrvlad("query", database, maps, "--as-paper")[2][-1]


def test_as_paper_contradicts_other_options(ssrvlad, refusal, database, maps):
    for option, name in [
        (("--sweep",), "--sweep"),
        (("--follow", "online", "--delay", 2), "--follow and --delay"),
        (("--temporal", 1), "--temporal"),
        (("--channel", "hog"), "--channel"),
    ]:
        line = refusal("query", database, maps, "--as-paper", *option)
        assert line.startswith("ssrvlad: --as-paper means --no-standardise --no-sweep")
        assert line.endswith(f"it contradicts {name}")
    alike = ("--no-sweep", "--follow", "no", "--temporal", 3, "--channel", "ssr-vlad")
    as_paper = ssrvlad("query", database, maps, "--as-paper")
    assert ssrvlad("query", database, maps, "--as-paper", *alike) == as_paper
    assert as_paper[0] == 0


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--temporal", "3m", "'--temporal': Input should be a valid integer"),
        ("--temporal", 10**7, "'--temporal': Input should be less than or equal to 1000000"),
        ("--as-of", 10**20, f"TOWN has no version {10**20}; it has 1 to 3"),
        ("--threshold", "nan", "'--threshold': Input should be less than or equal to 1"),
        ("--threshold", 2, "'--threshold': Input should be less than or equal to 1"),
    ],
)
def test_options_out_of_range_are_refused(refusal, database, maps, option, value, message):
    assert message.replace("TOWN", str(database)) in refusal("query", database, maps, option, value)


def _first(out: str) -> dict[str, str]:
    """The first candidate of each query."""
    return {line.split(": ")[0]: line.split()[1] for line in out.splitlines()}


def test_another_folder_of_the_same_name_is_another_sequence(ssrvlad, database, maps, tmp_path):
    other = write_maps(tmp_path / "other" / "monday", range(6))
    found = _first(ssrvlad("query", database, other, "--top", 1, "--exclude", 5)[1])
    assert found == {f"other/monday/{n:03d}": f"monday/{n:03d}" for n in range(6)}


def test_a_folder_that_the_database_knows_is_its_sequence(ssrvlad, encode, tmp_path):
    both = [write_maps(tmp_path / drive / "maps", range(6)) for drive in ("day", "dusk")]
    town = tmp_path / "both.ssrdb"
    encode(*both, "-o", town)
    found = _first(ssrvlad("query", town, both[1], "--top", 1, "--exclude", 5)[1])
    assert found == {f"dusk/maps/{n:03d}": f"day/maps/{n:03d}" for n in range(6)}


def test_the_folder_of_a_map_that_was_moved_needs_a_sequence_name(ssrvlad, refusal, database, maps):
    (maps.parent / "elsewhere").mkdir()
    moved = maps.rename(maps.parent / "elsewhere" / "monday")
    line = refusal("query", database, moved, "--exclude", 5)
    assert "which is gone: if" in line and "give --sequence monday" in line
    out = ssrvlad("query", database, moved, "--exclude", 5, "--sequence", "monday")[1]
    assert [line.split(": ")[1][:12] for line in out.splitlines()] == ["no candidate"] * 6


def test_the_line_of_steps_names_the_sequences_that_differ():
    assert by_sequence({"a": "offline", "b": "offline"}) == "offline"
    values = {"a": "no", **dict.fromkeys("bcdef", "offline")}
    assert by_sequence(values) == "no (a); offline (b, c, d and 2 more)"
