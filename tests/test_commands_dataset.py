"""Data sets on the command line: `--layout`, `--split`, `--role`, `--labels`, and what is true."""

import json
import shutil

import numpy as np
import pytest
from drives import vpr_bench, write_maps, write_photos, write_truth

from ssrvlad_torch.datasets.synthetic_city import write_city

CAMVID = ("--labels-as", "camvid-11")
ROLES = [("--role", "reference"), ("--role", "query")]


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """Eight frames of both drives through the city; not to be changed."""
    folder = tmp_path_factory.mktemp("made") / "city"
    write_city(folder, frames=8, seed=1, size=(60, 80))
    return folder


@pytest.fixture
def reference(ssrvlad, city, tmp_path):
    """A database of the references, the roles being those of the data set."""
    space = ("--labels-as", "cityscapes-trainids")
    db = tmp_path / "roles.ssrdb"
    code, out, _ = ssrvlad(
        "encode", city, "-o", db, *space, "--layout", "auto", "--role", "reference"
    )
    assert (code, "8 frames encoded" in out) == (0, True)
    return db


def test_roles_and_truth_come_from_the_data_set(ssrvlad, city, reference, tmp_path):
    db = tmp_path / "folders.ssrdb"
    ssrvlad("encode", city / "reference", "-o", db, "--labels-as", "cityscapes-trainids")
    truth = ("--ground-truth", city / "ground_truth.json")
    by_folders = ssrvlad("evaluate", db, city / "query", *truth, "--json")
    whole = ("evaluate", reference, city, "--layout", "auto", "--role", "query")
    assert ssrvlad(*whole, "--json") == by_folders
    assert json.loads(by_folders[1])["queries"] == 8
    assert ssrvlad(*whole, "--tolerance-metres", 5, "--json")[1] == by_folders[1]
    assert ssrvlad(*whole[:3], "--layout", "folders", "--split", "q*", "--json") == by_folders


def test_a_query_of_a_data_set(ssrvlad, city, reference):
    lines = [
        ssrvlad("query", reference, *where, "--top", 2)[1]
        for where in ((city / "query",), (city, "--layout", "auto", "--split", "query"))
    ]
    assert lines[0] == lines[1] != ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--layout", "auto", "--split", "nope"), "city has no sequence 'nope'; it has query, ref"),
        (("--split", "query"), "--split, --role and --labels need --layout, such as --layout auto"),
        (("--role", "query"), "need --layout"),
        (("--labels", "maps"), "need --layout"),
        (("--layout", "synthia"), "city is not in the layout synthia: expected"),
        (("--layout", "kitti"), "unknown layout 'kitti'; expected one of extended-cmu"),
        (("--layout", "auto", "--role", "loop"), "'loop' is not one of 'reference', 'query'"),
        (("--layout", "auto", "--labels", "nowhere"), "label maps in nowhere need a label space"),
    ],
)
def test_wrong_use_of_a_data_set(ssrvlad, city, reference, options, message):
    for command in ("query", "evaluate"):
        code, out, err = ssrvlad(command, reference, city, *options)
        assert (code, out, len(err)) == (2, "", 1)
        assert message in err[0]


def test_a_data_set_is_one_folder(ssrvlad, city, reference):
    code, _, err = ssrvlad("query", reference, city, city, "--layout", "auto")
    assert (code, err) == (
        2,
        ["ssrvlad: --layout: expected the folder of one data set, got 2 sources"],
    )


def test_headings_can_count(ssrvlad, city, reference):
    counts = []
    for limit in ((), ("--tolerance-degrees", 180), ("--tolerance-degrees", 0)):
        arguments = ("evaluate", reference, city / "query", "--tolerance-metres", 5, *limit)
        counts.append(json.loads(ssrvlad(*arguments, "--json")[1])["queries_with_match"])
    assert counts == [8, 8, 0]


# ---- ground truth that counts frames


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
