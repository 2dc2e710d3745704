"""Candidates around a place that is roughly known."""

import json
import math

import numpy as np
import pytest
from drawings import SPACE
from drives import write_maps

from ssrvlad_torch import Map
from ssrvlad_torch.search.near import Near

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
    *_, steps = ssrvlad("query", town, today, *near)[2]
    assert "candidates within 10 m of 20, 0: 3 frames" in steps
    truth = ("--tolerance-frames", 1, "--json")
    found = [
        json.loads(ssrvlad("evaluate", town, today, *truth, *some)[1])["recall_at"]["1"]
        for some in (near[2:], near)
    ]
    assert found[0] == 1 and found[1] < 1, "places outside are not found"


def test_commands_refuse_in_one_line(refusal, database, maps, posed, tmp_path):
    expected = "ssrvlad: near: expected X,Y,METRES, three finite numbers"
    assert refusal("query", "none.ssrdb", maps, "--near", "1,2").startswith(expected)
    assert "--near" not in refusal("query", database, maps, "--near", "-1,2,3")
    no_poses = f"ssrvlad: near: expected candidates with poses, {database} has none"
    assert refusal("query", database, maps, "--near", "1,2,3") == no_poses
    today = write_maps(tmp_path / "later" / "today", range(6))  # no table of poses beside it
    line = refusal("query", posed.path, today, "--near", "0,90,3")
    assert line.endswith("is within 3 m of 0, 90; the nearest is 90.0 m away")
