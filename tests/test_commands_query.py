"""`ssrvlad query` and `ssrvlad db info`."""

import json

import numpy as np
import pytest
from drawings import SPACE
from drives import write_maps
from helpers import street

from ssrvlad_torch import Database, SSRVLADConfig
from ssrvlad_torch.cli.words import by_sequence

REACH = "--temporal: expected frames (3) or metres (10m) up to 1000000"


def test_more_candidates_than_references_are_all_of_them(ssrvlad, database, maps):
    """What would not fit in memory is never allocated."""
    code, out, _ = ssrvlad("query", database, maps, "--top", 10**12, "--json")
    assert code == 0
    assert {len(json.loads(line)["candidates"]) for line in out.splitlines()} == {6}


def test_a_query_finds_itself(ssrvlad, database, maps):
    code, out, _ = ssrvlad("query", database, maps, "--top", 1)
    assert code == 0
    found = [line.split(" (")[0].rpartition(" ")[0] for line in out.splitlines()]
    assert found == [f"monday/{n:03d}: monday/{n:03d}" for n in range(6)]


def test_steps_are_told_and_taken(ssrvlad, database, maps):
    steps = ("--no-standardise", "--no-sweep", "--follow", "no")
    _, out, err = ssrvlad("query", database, maps, "--top", 1, *steps)
    ends = [line.split()[-4:] for line in out.splitlines()]
    assert ends == [["1.0000", "(cosine,", "confidence", "0.00)"]] * 6
    assert "not standardised, no sweep, followed: no, no temporal sum" in err[-1]
    sure = json.loads(ssrvlad("query", database, maps, "--json")[1].splitlines()[0])
    assert sure["confidence"] == 0 and sure["steps"]["standardise"] == {"monday": False}
    assert "6 references are too few" in err[-1]
    _, followed, err = ssrvlad("query", database, maps)
    assert "followed: offline" in err[-1] and "(probability, confidence" in followed
    assert sure["score_is"] == "probability"
    nothing = ssrvlad("query", database, maps, "--min-confidence", 1)[1].splitlines()
    assert all("no candidate" in line for line in nothing)
    assert "temporal sum t = 3" in ssrvlad("query", database, maps, "--as-paper")[2][-1]
    code, _, err = ssrvlad("query", database, maps, "--temporal", "3m")
    assert (code, len(err)) == (2, 1) and "'monday' has no poses" in err[0]
    code, _, err = ssrvlad("query", database, maps, "--temporal", "3x")
    assert (code, err) == (
        2,
        [f"ssrvlad: {REACH}, got '3x'"],
    )


def test_as_paper_contradicts_other_options(ssrvlad, database, maps):
    for option, name in [
        (("--sweep",), "--sweep"),
        (("--follow", "online", "--delay", 2), "--follow and --delay"),
        (("--temporal", 1), "--temporal"),
        (("--extra",), "--extra"),
    ]:
        code, _, err = ssrvlad("query", database, maps, "--as-paper", *option)
        assert (code, len(err)) == (2, 1), option
        assert err[0].startswith("ssrvlad: --as-paper means --no-standardise --no-sweep")
        assert err[0].endswith(f"it contradicts {name}")
    alike = ("--no-sweep", "--follow", "no", "--temporal", 3, "--no-extra")
    as_paper = ssrvlad("query", database, maps, "--as-paper")
    assert ssrvlad("query", database, maps, "--as-paper", *alike) == as_paper
    assert as_paper[0] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--temporal", "1e308m"), f"{REACH}, got '1e308m'"),
        (("--as-of", 10**20), f"TOWN has no version {10**20}; the first is 1"),
        (("--window", "10:4"), "--window: expected FIRST not above LAST, got '10:4'"),
        (
            ("--threshold", "nan"),
            "Invalid value for '--threshold': Input should be less than or equal to 1",
        ),
        (
            ("--threshold", 2),
            "Invalid value for '--threshold': Input should be less than or equal to 1",
        ),
    ],
)
def test_values_that_say_nothing(ssrvlad, database, maps, options, message):
    code, _, err = ssrvlad("query", database, maps, *options)
    assert (code, err) == (2, [f"ssrvlad: {message.replace('TOWN', str(database))}"])


def test_a_window_without_frames_is_refused(ssrvlad, database, maps):
    code, _, err = ssrvlad("query", database, maps, "--window", "900:950")
    message = f"ssrvlad: --window 900:950: no frame of {database} has such a number"
    assert (code, err) == (2, [message])


def test_nothing_that_can_be_described(ssrvlad, database, tmp_path):
    (tmp_path / "other").mkdir()
    np.save(tmp_path / "other" / "0.npy", np.full((24, 32), 77, np.uint8))
    code, out, err = ssrvlad("query", database, tmp_path / "other")
    assert (code, out) == (3, "")
    assert err[:2] == [
        "ssrvlad: no query could be described",
        "ssrvlad: no frame could be described: is --labels-as the label space of these label maps?",
    ]


def test_a_sum_in_metres_tells_its_t(ssrvlad, database, maps):
    (maps / "poses.csv").write_text(
        "frame,x,y\n" + "".join(f"{n:03d},{n * 2},0\n" for n in range(6))
    )
    ssrvlad("encode", maps, "-o", database)
    found = json.loads(
        ssrvlad("query", database, maps, "--temporal", "4.2m", "--json")[1].splitlines()[0]
    )
    assert found["temporal"] == {"monday": 2}


def test_enough_references_tell_how_sure(ssrvlad, database, maps):
    write_maps(maps, range(6, 30))
    ssrvlad("encode", maps, "-o", database)
    _, out, err = ssrvlad("query", database, maps, "--json")
    assert 0 < json.loads(out.splitlines()[0])["confidence"] < 1
    assert not any("too few" in line for line in err)


def test_label_maps_of_two_spaces_are_told_apart(ssrvlad, database, maps, tmp_path):
    other = write_maps(tmp_path / "tuesday", range(3))
    ssrvlad("encode", other, "-o", database, "--labels-as", "cityscapes-trainids")
    refused = [
        "ssrvlad: %s holds frames of camvid-11 and cityscapes-trainids; choose one with --labels-as"
    ]
    assert ssrvlad("query", database, maps)[::2] == (2, [refused[0] % database])
    assert ssrvlad("encode", other, "-o", database)[::2] == (2, [refused[0] % database])
    assert ssrvlad("query", database, maps, "--labels-as", "camvid-11")[0] == 0


def test_a_database_without_frames(ssrvlad, database, maps, tmp_path):
    db = tmp_path / "bare.ssrdb"
    Database.create(db, SSRVLADConfig(labels_as="camvid-11"))
    code, _, err = ssrvlad("query", db, maps)
    assert (code, err) == (2, [f"ssrvlad: {db} holds no frames yet"])


def test_info(ssrvlad, database):
    code, out, _ = ssrvlad("db", "info", database)
    assert code == 0
    assert "frames: 6" in out
    assert "sequences: monday 6" in out
    assert "extra" not in out and "thinning" not in out and "anchor vanishing-column" in out
    info = json.loads(ssrvlad("db", "info", database, "--json")[1])
    assert info["preset"] == "default"
    assert info["label_spaces"] == {"camvid-11": 6}
    assert info["config"] == SSRVLADConfig.from_preset("default", labels_as="camvid-11").to_dict()


def test_a_folder_of_the_same_name_is_another_drive(ssrvlad, database, maps, tmp_path):
    other = write_maps(tmp_path / "other" / "monday", range(6))
    found = _first(ssrvlad("query", database, other, "--top", 1, "--exclude", 5)[1])
    assert found == {f"other/monday/{n:03d}": f"monday/{n:03d}" for n in range(6)}


def test_a_folder_that_the_database_knows_is_its_sequence(ssrvlad, tmp_path):
    both = [write_maps(tmp_path / drive / "maps", range(6)) for drive in ("day", "dusk")]
    town = tmp_path / "both.ssrdb"
    ssrvlad("encode", *both, "-o", town, "--labels-as", "camvid-11")
    found = _first(ssrvlad("query", town, both[1], "--top", 1, "--exclude", 5)[1])
    assert found == {f"dusk/maps/{n:03d}": f"day/maps/{n:03d}" for n in range(6)}


def test_the_frames_of_another_database_are_named_apart(ssrvlad, database, tmp_path):
    other, others = write_maps(tmp_path / "other" / "monday", range(6)), tmp_path / "b.ssrdb"
    ssrvlad("encode", other, "-o", others, "--labels-as", "camvid-11")
    code, _, err = ssrvlad("query", database, others)
    assert code == 2 and len(err) == 1 and "give --sequence monday if" in err[0]
    found = _first(ssrvlad("query", database, others, "--sequence", "b", "--top", 1)[1])
    assert found == {f"b/{n:03d}": f"monday/{n:03d}" for n in range(6)}


def test_a_map_that_was_moved_is_asked_for_its_name(ssrvlad, database, maps):
    (maps.parent / "elsewhere").mkdir()
    moved = maps.rename(maps.parent / "elsewhere" / "monday")
    code, _, err = ssrvlad("query", database, moved, "--exclude", 5)
    assert code == 2 and "which is gone: if" in err[0] and "give --sequence monday" in err[0]
    out = ssrvlad("query", database, moved, "--exclude", 5, "--sequence", "monday")[1]
    assert [line.split(": ")[1][:12] for line in out.splitlines()] == ["no candidate"] * 6


def _first(out: str) -> dict[str, str]:
    """The first candidate of each query."""
    return {line.split(": ")[0]: line.split()[1] for line in out.splitlines()}


def test_as_many_as_an_estimate_permits(ssrvlad, tmp_path):
    """The mirrored map is asked, so that no answer is right; then the map itself."""
    streets = [street(seed) for seed in range(60)]
    for name, maps in (("town", streets), ("mirrored", [each[:, ::-1] for each in streets])):
        (tmp_path / name).mkdir()
        for number, labels in enumerate(maps):
            np.save(tmp_path / name / f"{number:03}.npy", labels)
    town = tmp_path / "town.ssrdb"
    assert ssrvlad("encode", tmp_path / "town", "-o", town, "--labels-as", SPACE)[0] == 0
    ask = "query", town, tmp_path / "town", "--follow", "no", "--max-wrong", 0.1
    code, out, err = ssrvlad(*ask)
    assert code == 0 and all("no candidate" not in line for line in out.splitlines())
    assert "; accepted 60 answers of confidence " in err[0]
    assert "; 1.7% estimated to be wrong (95 % interval 0.0% to " in err[0]
    code, out, _ = ssrvlad(*ask, "--json")
    lines = [json.loads(line) for line in out.splitlines()]
    assert lines[0]["estimate"] == lines[-1]["estimate"]
    assert lines[0]["estimate"]["accepted"] == 60 and lines[0]["estimate"]["low"] == 0
    ask = "query", town, tmp_path / "mirrored", "--follow", "no", "--max-wrong", 0.1
    code, out, err = ssrvlad(*ask)
    assert all("no candidate" in line for line in out.splitlines())
    assert err[0].endswith("; no answer is accepted")
    both = "query", town, tmp_path / "town", "--max-wrong", 0.1, "--min-confidence", 0.5
    assert ssrvlad(*both)[0] == 2


def test_the_line_of_steps_names_the_sequences_that_differ():
    assert by_sequence({"a": "offline", "b": "offline"}) == "offline"
    values = {"a": "no", **dict.fromkeys("bcdef", "offline")}
    assert by_sequence(values) == "no (a); offline (b, c, d and 2 more)"
