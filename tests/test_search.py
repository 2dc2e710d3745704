"""The search for candidates in a database: of which frames, by which descriptors, how sure."""

import json
import math

import numpy as np
import pytest
import torch
from drawings import SPACE
from helpers import street, write_maps
from hypothesis import given
from hypothesis import strategies as st
from loop_streams import objects

from ssrvlad_torch import Map
from ssrvlad_torch.database.frames import FrameSet
from ssrvlad_torch.datasets.names import sequence_of, split_id
from ssrvlad_torch.files import natural_key
from ssrvlad_torch.search.selection import Near, neighbours


def test_nothing_that_can_be_described(ssrvlad, database, tmp_path):
    (tmp_path / "other").mkdir()
    np.save(tmp_path / "other" / "0.npy", np.full((24, 32), 77, np.uint8))
    code, out, err = ssrvlad("query", database, tmp_path / "other")
    assert (code, out) == (2, "")
    assert err[0].startswith("ssrvlad: no answer is accepted")
    assert err[1] == (
        "ssrvlad: no frame could be described: is --labels-as the label space of these label maps?"
    )


def test_label_maps_of_two_spaces_are_told_apart(ssrvlad, database, maps, tmp_path):
    other = write_maps(tmp_path / "tuesday", range(3))
    ssrvlad("encode", other, "-o", database, "--labels-as", "cityscapes-trainids")
    spaces = "camvid-11 and cityscapes-trainids; choose one with --labels-as"
    refusal = (2, [f"ssrvlad: {database} holds frames of {spaces}"])
    assert ssrvlad("query", database, maps)[::2] == refusal
    assert ssrvlad("encode", other, "-o", database)[::2] == refusal
    assert ssrvlad("query", database, maps, "--labels-as", "camvid-11")[0] == 0


def test_the_frames_of_another_database_are_named_apart(ssrvlad, database, tmp_path):
    other, others = write_maps(tmp_path / "other" / "monday", range(6)), tmp_path / "b.ssrdb"
    ssrvlad("encode", other, "-o", others, "--labels-as", "camvid-11")
    code, _, err = ssrvlad("query", database, others)
    assert code == 2 and len(err) == 1 and "give --sequence monday if" in err[0]
    out = ssrvlad("query", database, others, "--sequence", "b", "--top", 1)[1].splitlines()
    expected = [f"b/{n:03d}: monday/{n:03d}" for n in range(6)]
    assert [" ".join(line.split()[:2]) for line in out] == expected
    for options in (("--every", 2), ("--poses", "exif"), ("--topic", "t", "--fps", 2)):
        code, _, (line,) = ssrvlad("query", database, others, "--sequence", "b", *options)
        unused = ", ".join(options[::2])
        assert (code, line) == (2, f"ssrvlad: {others} is a database: expected no {unused}")


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
    assert code == 0 and all("refused" not in line for line in out.splitlines())
    assert "60 answers of confidence " in err[0] and "about 0 wrong (0 to " in err[0]
    lines = objects(ssrvlad(*ask, "--json")[1])
    assert lines[0]["estimate"] == lines[-1]["estimate"]
    assert lines[0]["estimate"]["accepted"] == 60 and lines[0]["estimate"]["low"] == 0
    ask = "query", town, tmp_path / "mirrored", "--follow", "no", "--max-wrong", 0.1
    code, out, err = ssrvlad(*ask)
    assert all(": refused (" in line for line in out.splitlines())
    assert err[0].startswith("ssrvlad: no answer is accepted")
    both = "query", town, tmp_path / "town", "--max-wrong", 0.1, "--min-confidence", 0.5
    assert ssrvlad(*both)[0] == 2


# ---- candidates around a place that is roughly known


POSES = np.array([[0, 0, 0], [3, 4, math.nan], [6, 8, 1], [math.nan] * 3])


@pytest.fixture
def posed(tmp_path):
    """A map of six label maps, ten metres apart along x; the last has no pose."""
    maps = write_maps(tmp_path / "monday", range(6))
    rows = [f"monday/{n:03d},{10 * n},0,0" for n in range(5)]
    (tmp_path / "poses.csv").write_text("\n".join(["frame,x,y,heading", *rows]))
    town = Map.open(tmp_path / "posed.ssrdb", labels_as=SPACE)
    town.add(maps)
    return town


def test_the_rows_inside():
    """The border is inside, an unknown pose is not."""
    assert Near.of((0, 0, 5)).rows(POSES, "town").tolist() == [True, True, False, False]
    assert Near.of("6,8,0").rows(POSES, "town").tolist() == [False, False, True, False]
    assert str(Near.of("-1.5,2e3,0.5")) == "within 0.5 m of -1.5, 2000"


TEXTS = ("", "1,2", "1,2,3,4", "1,2,-3", "1,nan,3", "1,2,inf", "a,b,c", "1;2;3", "1_0,2,3")
OTHERS = ((1, 2), (1, 2, -1), (math.nan, 0, 1), ("1", "2", "3"), 5, [None] * 3)


@pytest.mark.parametrize("given", [*TEXTS, *OTHERS])
def test_a_circle_is_three_finite_numbers(given):
    with pytest.raises(ValueError, match="near: expected X,Y,METRES, three finite numbers") as got:
        Near.of(given)
    assert str(given) in str(got.value)


def test_commands_say_where_candidates_are(ssrvlad, posed, tmp_path):
    today, town = write_maps(tmp_path / "today", range(6)), posed.path
    near = ("--near", "20,0,10", "--follow", "no")
    code, out, _ = ssrvlad("query", town, today, *near, "--json")
    assert code == 0
    for line in map(json.loads, out.splitlines()):
        inside = {each["frame"] for each in line["candidates"]}
        assert inside == {f"monday/00{n}" for n in (1, 2, 3)}
    *_, steps = ssrvlad("query", town, today, *near, "--verbose")[2]
    assert "candidates within 10 m of 20, 0: 3 frames" in steps
    truth = ("--tolerance-frames", 1, "--json")
    found = [
        json.loads(ssrvlad("evaluate", town, today, *truth, *some)[1])["recall_at"]["1"]
        for some in (near[2:], near)
    ]
    assert found[0] == 1 and found[1] < 1, "places outside are not found"


def test_an_evaluation_by_headings_leaves_out_unknown_ones_inside_a_circle_too(posed, tmp_path):
    rows = [f"monday/{n:03d},{10 * n},0,{'' if n % 2 else 0}" for n in range(5)]
    (tmp_path / "poses.csv").write_text("\n".join(["frame,x,y,heading", *rows]))
    posed.add(tmp_path / "monday")
    limits = {"tolerance_metres": 15.0, "tolerance_degrees": 5.0}
    found = posed.evaluate(tmp_path / "monday", near=(0, 0, 25), **limits)
    assert found.metrics["steps"]["near"] == "of known pose within 25 m of 0, 0: 2 frames"


# ---- selection of references


def frame_set(*frames):
    """Frames without descriptors, in natural order."""
    ordered = sorted(frames, key=lambda frame: tuple(map(natural_key, split_id(frame))))
    return FrameSet(
        frames=tuple(ordered),
        sequences=tuple(sequence_of(frame) for frame in ordered),
        channels={"descriptor": torch.zeros(len(ordered), 0)},
        poses=np.zeros((len(ordered), 3)),
        stamps=np.zeros(len(ordered)),
        empty=np.zeros(len(ordered), bool),
    )


@given(st.sets(st.integers(0, 30)), st.integers(0, 40), st.integers(0, 5))
def test_neighbours_are_the_frames_around_the_position_of_a_query(numbers, query, reach):
    references = frame_set("a/5", "z/5", *(f"m/{number}" for number in numbers))
    [(first, last)] = neighbours([f"m/{query}"], references, reach)
    found = [int(frame[2:]) for frame in references.frames[first:last]]
    below = sorted(n for n in numbers if n < query)
    above = sorted(n for n in numbers if n > query)
    expected = below[len(below) - min(reach, len(below)) :] + [query] * (query in numbers)
    assert found == expected + above[:reach]
