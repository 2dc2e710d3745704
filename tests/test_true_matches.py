"""Ground truths that count frames: by the frames of the data set, not by those that are used."""

import json
import shutil

import numpy as np
import pytest
from drives import vpr_bench, write_maps, write_photos, write_truth

CAMVID = ("--labels-as", "camvid-11")
ROLES = [("--role", "reference"), ("--role", "query")]


@pytest.fixture
def bench(tmp_path):
    """A VPR-Bench data set of six places, with the label maps of both drives beside it; of the
    queries, numbers 1 and 4 have no true match."""
    root = tmp_path / "bench"
    for folder in ("query", "ref"):
        write_photos(root / folder, range(6), ".jpg")
        write_maps(tmp_path / "maps" / folder, range(6))
    write_truth(root / "ground_truth_new.npy", vpr_bench([[0], [], [2], [3], [], [5]]))
    return root


@pytest.fixture
def recognise(ssrvlad, bench, tmp_path):
    """Encodes the references and evaluates the queries, with options of both and of each."""
    maps = ("--layout", "vpr-bench", "--labels", tmp_path / "maps", *CAMVID)

    def run(encoding: tuple[object, ...] = (), querying: tuple[object, ...] = ()):
        db = tmp_path / "bench.ssrdb"
        shutil.rmtree(db, ignore_errors=True)
        assert ssrvlad("encode", bench, "-o", db, *maps, *ROLES[0], *encoding)[0] in (0, 3)
        code, out, err = ssrvlad(
            "evaluate", db, bench, *maps, *ROLES[1], "--temporal", 0, *querying, "--json"
        )
        metrics = json.loads(out) if out else {}
        return code, metrics, err

    return run


def figures(metrics: dict[str, object]) -> tuple[object, ...]:
    return metrics["queries"], metrics["queries_with_match"], metrics["recall_at"]["1"]


def test_the_truth_of_a_whole_data_set(recognise):
    code, metrics, err = recognise()
    assert (code, err, figures(metrics)) == (0, [], (6, 4, 1.0))


def test_numbers_of_the_truth_count_images_not_label_maps(recognise, tmp_path):
    """The label map of the second query and that of the first reference are missing: the truth
    still speaks of the same images."""
    (tmp_path / "maps" / "query" / "001.png").unlink()
    (tmp_path / "maps" / "ref" / "000.png").unlink()
    code, metrics, err = recognise()
    assert (code, figures(metrics)) == (0, (5, 3, 1.0))
    assert metrics["references"] == 5
    assert err == [
        "ssrvlad: 1 of 6 frames have no label map, the first is query/001",
        f"ssrvlad: 1 references of {tmp_path}/bench/ground_truth_new.npy are not in the "
        "database, the first is ref/000",
    ]


def test_numbers_of_the_truth_count_images_not_every_so_many(recognise):
    odd = ("--every", 2, "--start", 1)
    assert figures(recognise(querying=odd)[1]) == (3, 2, 1.0)
    code, metrics, err = recognise(encoding=odd)
    assert (code, figures(metrics)) == (0, (6, 2, 1.0))
    assert "2 references of " in err[0]
    assert "are not in the database, the first is ref/000" in err[0]


def test_a_skipped_frame_keeps_its_number(recognise, tmp_path):
    for folder in ("ref", "query"):
        (tmp_path / "maps" / folder / "000.png").write_text("no image")
    code, metrics, _ = recognise()
    assert (code, figures(metrics)) == (3, (5, 3, 1.0))


def test_frames_of_the_tolerance_are_those_of_the_data_set(recognise):
    third = ("--every", 3)
    near = ("--tolerance-frames", 1, "--every", 3, "--start", 1)
    assert figures(recognise(third, near)[1])[:2] == (2, 2)
    apart = ("--tolerance-frames", 0, "--every", 3, "--start", 1)
    assert figures(recognise(third, apart)[1])[:2] == (2, 0)


def test_a_matrix_is_of_all_frames(recognise, tmp_path):
    matrix = ("--ground-truth", write_truth(tmp_path / "truth.npy", np.eye(6)))
    odd = ("--every", 2, "--start", 1)
    assert figures(recognise(querying=(*matrix, *odd))[1]) == (3, 3, 1.0)
    small = ("--ground-truth", write_truth(tmp_path / "small.npy", np.eye(3)))
    code, _, err = recognise(querying=(*small, *odd))
    assert (code, len(err)) == (2, 1)
    assert "is a matrix of shape (3, 3), expected (6, 6)" in err[0]
