"""Every program that finds places and loops. Places are those of the core by the descriptors of the
package: test_native_map.py and test_decide.py hold the core to formulas. Loops are those of the
formulas."""

import json
import math
import re
import subprocess
from subprocess import PIPE

import numpy as np
import pytest
from conformance.decisions import (
    ASKED,
    CLOSED,
    CLOSERS,
    FOLLOWERS,
    LOOPS,
    PLACES,
    arrays_of,
    by_the_core,
    live,
    loops_by_oracle,
)
from helpers import outcome
from natsort import natsorted

from ssrvlad_torch import Database
from ssrvlad_torch.recognition.sweep import COLUMNS


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The folder of each scene, and what is made there once."""
    made = {}

    def of(kinds, name, request):
        if (id(kinds), name) not in made:
            folder = tmp_path_factory.mktemp(re.sub(r"\W", "-", name))
            made[id(kinds), name] = kinds[name](folder, request.getfixturevalue)
        return made[id(kinds), name]

    return of


ANSWERS = {}


@pytest.mark.parametrize(("name", "scene", "mode"), ASKED)
def test_places_are_those_of_the_core(name, scene, mode, folders, request):
    files = folders(PLACES, scene, request)
    get = request.getfixturevalue
    columns = COLUMNS if files.columns and name == "ssrvlad query" else files.columns
    if (scene, mode, columns) not in ANSWERS:
        ANSWERS[scene, mode, columns] = by_the_core(files, mode, columns)
    answers = FOLLOWERS[name](files, mode, get)
    asked = {line["query"] for line in answers}  # of some programs a few
    expected = ANSWERS[scene, mode, columns]
    expected = [line for line in expected if line["query"] in asked]
    exact = 6e-3 if name == "page" else 1e-4  # the page shows two digits
    assert len(answers) > 3
    for line, right in zip(sorted_by_query(answers), sorted_by_query(expected), strict=True):
        assert line["query"] == right["query"]
        assert line.get("score_is", right["score_is"]) == right["score_is"]
        sure = line.get("confidence", right["confidence"])
        assert sure == pytest.approx(right["confidence"], abs=exact)
        ours, theirs = scores_of(line), scores_of(right)
        assert [*ours][:1] == [*theirs][:1]
        for frame in ours.keys() | (theirs.keys() if name != "page" else ()):
            # rows that are hardly believed change places
            assert ours.get(frame, 0) == pytest.approx(theirs.get(frame, 0), abs=1e-4)


@pytest.mark.parametrize("program", ["run_onnx.py", "C++"])
def test_an_answer_is_printed_once_two_later_frames_have_come(program, folders, request):
    """The next name is written only then; the lines are those of the folder."""
    scene = folders(PLACES, "label maps", request)
    command, [folder, _] = live(program, scene, request.getfixturevalue), arrays_of(scene)
    code, expected, errors = outcome(*command(folder))
    assert (code, errors) == (0, [])
    lines = []
    with subprocess.Popen(command("-"), stdin=PIPE, stdout=PIPE, text=True) as process:
        for number, file in enumerate(natsorted(folder.iterdir())):
            print(file, file=process.stdin, flush=True)
            if number >= 2:
                lines.append(process.stdout.readline())
        lines += process.communicate()[0].splitlines()
    assert [line.strip() for line in lines] == expected
    answers = [json.loads(line) for line in lines]
    assert [answer["settled"] for answer in answers] == [False] * 30 + [True] * 6
    town = Database.open(scene.town.with_suffix(".ssrdb")).load()
    poses = dict(zip(town.frames, town.poses.tolist(), strict=True))
    for answer in answers:
        pose = poses[answer["candidates"][0]["frame"]]
        assert [*answer["poses"][0].values()] == [None if math.isnan(n) else n for n in pose]
    assert np.isfinite(town.poses).all(1).sum() == 36


def sorted_by_query(lines):
    return sorted(lines, key=lambda line: line["query"])


def scores_of(line, number="score"):
    return {candidate["frame"]: candidate[number] for candidate in line["candidates"]}


@pytest.mark.parametrize(("name", "scene"), CLOSED)
def test_loops_are_those_of_the_formulas(name, scene, folders, request):
    files, get = folders(LOOPS, scene, request), request.getfixturevalue
    if scene not in ANSWERS:
        ANSWERS[scene] = loops_by_oracle(files)
    expected, lines = ANSWERS[scene], CLOSERS[name](files, get)
    assert sum(line["reason"] == "accepted" for line in expected) > 5
    for line, right in zip(lines, expected, strict=True):
        for field in ("frame", "reason", "candidate"):
            assert line[field] == right[field], line["frame"]
        for field in ("score", "confidence"):
            assert line[field] == pytest.approx(right[field], abs=3e-4), line["frame"]
        ours, theirs = (scores_of(one, "confidence") for one in (line, right))
        assert ours == pytest.approx(theirs, abs=3e-4), line["frame"]
