"""Ground truths that count frames: by the frames of the data set, not by those that are used."""

import json
import shutil

import numpy as np
import pytest
from drives import write_maps, write_photos, write_truth

CAMVID = ("--labels-as", "camvid-11")
COUNTS = ("references", "queries", "queries_with_match")
ROLES = [("--role", "reference"), ("--role", "query")]


@pytest.fixture
def bench(tmp_path):
    """A VPR-Bench data set of six places, with the label maps of both drives beside it; of the
    queries, numbers 1 and 4 have no true match."""
    root = tmp_path / "bench"
    for folder in ("query", "ref"):
        write_photos(root / folder, range(6), ".jpg")
        write_maps(tmp_path / "maps" / folder, range(6))
    rows = enumerate([[0], [], [2], [3], [], [5]])
    write_truth(root / "ground_truth_new.json", [*rows])
    return root


@pytest.fixture
def recognise(ssrvlad, bench, tmp_path):
    """Encodes the references and evaluates the queries, with options of both and of each."""
    maps = ("--layout", "vpr-bench", "--labels", tmp_path / "maps", *CAMVID)

    def run(encoding: tuple[object, ...] = (), querying: tuple[object, ...] = ()):
        """The exit code, references, queries, those with a match, RecallRate@1; and stderr."""
        db = tmp_path / "bench.ssrdb"
        shutil.rmtree(db, ignore_errors=True)
        assert ssrvlad("encode", bench, "-o", db, *maps, *ROLES[0], *encoding)[0] in (0, 3)
        code, out, err = ssrvlad(
            "evaluate", db, bench, *maps, *ROLES[1], "--temporal", 0, *querying, "--json"
        )
        metrics = json.loads(out) if out else {"recall_at": {"1": None}}
        figures = (metrics.get(name) for name in COUNTS)
        return (code, *figures, metrics["recall_at"]["1"]), err

    return run


def test_numbers_of_the_truth_count_images_not_label_maps(recognise, tmp_path):
    """The label map of the second query and that of the first reference are missing: the truth
    still speaks of the same images."""
    assert recognise() == ((0, 6, 6, 4, 1.0), [])
    (tmp_path / "maps" / "query" / "001.png").unlink()
    (tmp_path / "maps" / "ref" / "000.png").unlink()
    figures, err = recognise()
    assert figures == (0, 5, 5, 3, 1.0)
    assert err == [
        "ssrvlad: 1 of 6 frames have no label map, the first is query/001",
        f"ssrvlad: 1 references of {tmp_path}/bench/ground_truth_new.json are not in the "
        "database, the first is ref/000",
    ]


ODD = ("--every", 2, "--start", 1)


def test_numbers_of_the_truth_count_images_not_every_so_many(recognise):
    assert recognise(querying=ODD)[0] == (0, 6, 3, 2, 1.0)
    figures, err = recognise(encoding=ODD)
    assert figures == (0, 3, 6, 2, 1.0)
    assert "2 references of " in err[0]
    assert "are not in the database, the first is ref/000" in err[0]


def test_a_skipped_frame_keeps_its_number(recognise, tmp_path):
    for folder in ("ref", "query"):
        (tmp_path / "maps" / folder / "000.png").write_text("no image")
    assert recognise()[0] == (3, 5, 5, 3, 1.0)


@pytest.mark.parametrize(("frames", "with_match"), [(1, 2), (0, 0)])
def test_frames_of_the_tolerance_are_those_of_the_data_set(recognise, frames, with_match):
    near = ("--tolerance-frames", frames, "--every", 3, "--start", 1)
    assert recognise(("--every", 3), near)[0][:4] == (0, 2, 2, with_match)


def test_a_matrix_is_of_all_frames(recognise, tmp_path):
    matrix = ("--ground-truth", write_truth(tmp_path / "truth.npy", np.eye(6)))
    assert recognise(querying=(*matrix, *ODD))[0] == (0, 6, 3, 3, 1.0)
    small = ("--ground-truth", write_truth(tmp_path / "small.npy", np.eye(3)))
    figures, err = recognise(querying=(*small, *ODD))
    assert (figures[0], len(err)) == (2, 1)
    assert "is a matrix of shape (3, 3), expected (6, 6)" in err[0]
