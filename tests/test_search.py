"""The search for candidates in a database: of which frames, by which descriptors, how sure."""

import json

import numpy as np
from drawings import SPACE
from drives import write_maps
from helpers import street
from loop_streams import objects

from ssrvlad_torch import Database, SSRVLADConfig


def test_nothing_that_can_be_described(ssrvlad, database, tmp_path):
    (tmp_path / "other").mkdir()
    np.save(tmp_path / "other" / "0.npy", np.full((24, 32), 77, np.uint8))
    code, out, err = ssrvlad("query", database, tmp_path / "other")
    assert (code, out) == (3, "")
    assert err[:2] == [
        "ssrvlad: no query could be described",
        "ssrvlad: no frame could be described: is --labels-as the label space of these label maps?",
    ]


def test_enough_references_tell_how_sure(ssrvlad, database, maps):
    write_maps(maps, range(6, 30))
    ssrvlad("encode", maps, "-o", database)
    _, out, err = ssrvlad("query", database, maps, "--json")
    assert 0 < json.loads(out.splitlines()[0])["confidence"] < 1
    *_, note = ssrvlad("query", database, maps, "--threshold", 0.99)[2]
    assert note.endswith("), before --threshold")
    assert not any("too few" in line for line in err)


def test_label_maps_of_two_spaces_are_told_apart(ssrvlad, database, maps, tmp_path):
    other = write_maps(tmp_path / "tuesday", range(3))
    ssrvlad("encode", other, "-o", database, "--labels-as", "cityscapes-trainids")
    spaces = "camvid-11 and cityscapes-trainids; choose one with --labels-as"
    refusal = (2, [f"ssrvlad: {database} holds frames of {spaces}"])
    assert ssrvlad("query", database, maps)[::2] == refusal
    assert ssrvlad("encode", other, "-o", database)[::2] == refusal
    assert ssrvlad("query", database, maps, "--labels-as", "camvid-11")[0] == 0


def test_a_database_without_frames(ssrvlad, maps, tmp_path):
    db = tmp_path / "bare.ssrdb"
    Database.create(db, SSRVLADConfig(labels_as="camvid-11"))
    assert ssrvlad("query", db, maps)[::2] == (2, [f"ssrvlad: {db} holds no frames yet"])


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
    assert code == 0 and all("no candidate" not in line for line in out.splitlines())
    assert "; accepted 60 answers of confidence " in err[0]
    assert "% estimated to be wrong (95 % interval 0.0% to " in err[0]
    lines = objects(ssrvlad(*ask, "--json")[1])
    assert lines[0]["estimate"] == lines[-1]["estimate"]
    assert lines[0]["estimate"]["accepted"] == 60 and lines[0]["estimate"]["low"] == 0
    ask = "query", town, tmp_path / "mirrored", "--follow", "no", "--max-wrong", 0.1
    code, out, err = ssrvlad(*ask)
    assert all("no candidate" in line for line in out.splitlines())
    assert err[0].endswith("; no answer is accepted")
    both = "query", town, tmp_path / "town", "--max-wrong", 0.1, "--min-confidence", 0.5
    assert ssrvlad(*both)[0] == 2
