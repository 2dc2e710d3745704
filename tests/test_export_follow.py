"""The program that finds drives without torch, against the command line."""

import shutil
import sys
from functools import partial
from pathlib import Path

import follow_onnx as program
import numpy as np
import pytest
import run_onnx
from cases import REAL, needs_real
from graphs import without_property
from helpers import outcome, without
from loop_streams import objects
from segmenting import write_drives, write_map, write_moved_drives, write_town

from ssrvlad_torch import SSRVLADConfig, export_head, native
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.recognition.sweep import COLUMNS

SPACE = "cityscapes-trainids"

pytestmark = [
    pytest.mark.usefixtures("core"),
    pytest.mark.filterwarnings("error::RuntimeWarning"),
]


@pytest.fixture
def town(ssrvlad, tmp_path):
    """A function that stores a map, and its files: of a head that sweeps or not, and of the
    descriptors."""

    def store(*maps, columns=()):
        head, exported = tmp_path / "head.onnx", tmp_path / "town.npy"
        export_head(SSRVLADConfig(labels_as=SPACE), head, dtype="int64", columns=columns)
        return write_map(ssrvlad, exported, *maps), head, exported

    return store


@pytest.fixture
def follow(main_of):
    return partial(main_of, program.main, "follow_onnx.py")


def first(out):
    return {line["query"]: line["candidates"][0] for line in objects(out)}


def assert_as_query(out, expected, atol=1e-4):
    """The same lines as of the command line, but for the last digits of numbers. Of rows that are
    hardly believed any may come later."""
    for line, right in zip(objects(out), objects(expected), strict=True):
        for name in ("query", "score_is"):
            assert line[name] == right[name]
        assert line["confidence"] == pytest.approx(right["confidence"], abs=atol)
        scores, others = (
            {each["frame"]: each["score"] for each in told["candidates"]} for told in (line, right)
        )
        assert [*scores][:1] == [*others][:1]
        for frame in {*scores, *others}:
            assert scores.get(frame, 0) == pytest.approx(others.get(frame, 0), abs=atol)


@pytest.mark.parametrize("columns", [(), COLUMNS])
@pytest.mark.parametrize(
    "steps", [(), ("--follow", "online", "--delay", 3), ("--follow", "no", "--top", 2)]
)
def test_a_drive_is_found_as_by_query(follow, ssrvlad, town, tmp_path, columns, steps):
    """In a map of two drives, one of them of another city, with a sweep and without."""
    city = write_city(tmp_path / "city", frames=40, size=(60, 80), seed=3)
    other = write_city(tmp_path / "b", frames=12, size=(60, 80), seed=1)
    maps = city / "reference", (other / "reference").rename(tmp_path / "other")
    database, head, exported = town(*maps, columns=columns)
    code, out, err = follow(head, city / "query", "--database", exported, "--json", *steps)
    assert (code, err) == (0, [])
    given = steps if columns else (*steps, "--no-sweep")
    assert_as_query(out, ssrvlad("query", database, city / "query", *given, "--json")[1])


def test_single_pictures_are_judged_alone_as_by_query(follow, ssrvlad, town, tmp_path):
    """Eight of a shuffled drive."""
    city = write_city(tmp_path / "city", frames=40, size=(60, 80), seed=3)
    database, head, exported = town(city / "reference")
    order = np.random.default_rng(0).permutation(sorted((city / "query").glob("*.png")))[:8]
    (tmp_path / "some").mkdir()
    for number, file in enumerate(order):
        (tmp_path / "some" / f"{number}.png").write_bytes(Path(file).read_bytes())
    code, out, _ = follow(head, tmp_path / "some", "--database", exported, "--json")
    assert code == 0 and '"score_is": "cosine"' in out
    expected = ssrvlad("query", database, tmp_path / "some", "--no-sweep", "--json")[1]
    assert_as_query(out, expected)


def test_pictures_are_found_by_all_channels_as_by_query(follow, ssrvlad, tmp_path):
    """Also moved by two cells; without a sweep most are not found. Without torch it is the same."""
    exported = tmp_path / "town.npy"
    query = write_moved_drives(ssrvlad, tmp_path, exported)
    given = (tmp_path / "place.onnx", tmp_path / "today", "--database", exported, "--json")
    code, out, err = follow(*given)
    assert (code, err) == (0, [])
    same, still = (first(ssrvlad(*query, *options)[1]) for options in ((), ("--no-sweep",)))
    got = first(out)
    assert len(got) == 33 and [*got] == [*same]
    for frame, candidate in got.items():
        assert candidate["frame"] == same[frame]["frame"] == frame.replace("today", "monday")
        assert candidate["score"] == pytest.approx(same[frame]["score"], abs=1e-4)
    assert np.mean([got[frame]["frame"] == still[frame]["frame"] for frame in got]) < 0.5
    code, lines, errors = outcome(*without(("torch",), Path(program.__file__), *given))
    assert (code, lines, errors) == (0, out.splitlines(), [])


def test_a_file_without_hog_says_so_once(follow, tmp_path):
    """The file is of an older `fuse`, which gave no HOG; the database has it."""
    write_drives(tmp_path, range(36), range(2, 35), (96, 128))
    write_town(tmp_path, tmp_path / "town.npy")
    plain = without_property(tmp_path / "place.onnx", tmp_path / "plain.onnx", "hog")
    given = (plain, tmp_path / "today", "--database", tmp_path / "town.npy")
    code, out, (line,) = follow(*given, "--json")
    assert (code, out.count("\n")) == (0, 33)
    town = tmp_path / "town.npy"
    assert line == f"only {town} has hog: frames are matched without; fuse the file again"


def test_a_library_of_another_version_is_one_line(town, tmp_path):
    city = write_city(tmp_path / "city", frames=3, size=(60, 80))
    _, head, exported = town(city / "reference")
    package = tmp_path / "other" / "ssrvlad_torch"
    shutil.copytree(native.FOLDER, package / "native")
    shutil.copy(native.FOLDER.parent / "__init__.py", package)
    with (package / "native" / "map.cpp").open("a") as source:
        source.write("// changed\n")
    given = (program.__file__, head, city / "query", "--database", exported)
    code, out, (line,) = outcome("env", f"PYTHONPATH={package.parent}", sys.executable, *given)
    assert (code, out) == (2, [])
    assert line.startswith("follow_onnx: the native core is of another version: install ")


def test_wrong_use_is_one_line(main_of, town, tmp_path):
    city = write_city(tmp_path / "city", frames=2, size=(60, 80))
    _, head, exported = town(city / "reference")
    follow = partial(main_of, program.main, "follow_onnx.py", head)
    code, _, (line,) = follow(tmp_path / "none", "--database", exported)
    assert code == 2 and line.startswith("follow_onnx: ") and "none does not exist" in line
    np.save(tmp_path / "none.npy", np.zeros((0, 480), np.float32))
    (tmp_path / "none.npy.frames.txt").touch()
    code, _, err = follow(city / "query", "--database", tmp_path / "none.npy")
    assert code == 2 and err[-1] == f"follow_onnx: {tmp_path / 'none.npy'} holds no frames"
    np.save(tmp_path / "void.npy", np.zeros((2, 480), np.float32))
    (tmp_path / "void.npy.frames.txt").write_text("a/0\na/1\n")
    code, out, _ = follow(city / "query", "--database", tmp_path / "void.npy", "--json")
    assert code == 0
    for line in objects(out):
        assert (line["candidates"], line["empty"]) == ([], False)
    (city / "query" / "torn.png").write_bytes(b"torn")
    code, out, err = follow(city / "query", "--database", exported)
    assert (code, out.count("\n"), err[-1]) == (3, 2, "skipped 1 of 3 frames")


@pytest.mark.slow
@needs_real
def test_following_finds_the_figures_of_the_readme(main_of, ssrvlad, town):
    """The figures of export/README.md: UofA, evening against day, one row to each side."""
    day, evening = (REAL / "uofa" / each / "predicted_espnetv2" for each in ("day", "evening"))
    database, head, exported = town(day)
    recalls = []
    for main in (run_onnx.main, program.main):
        out = main_of(main, "x", head, evening, "--database", exported, "--json")[1]
        recalls.append(recall(first(out)))
    recalls.append(recall(first(ssrvlad("query", database, evening, "--no-sweep", "--json")[1])))
    assert [f"{each:.2f}" for each in recalls] == ["0.53", "1.00", "1.00"]


@pytest.mark.slow
@needs_real
def test_features_find_the_figures_of_the_readme(main_of, ssrvlad, tmp_path):
    """The figures of export/README.md: UofA, evening against day, by pictures."""
    network = REAL / "networks" / "espnetv2.yaml"
    day, evening = (REAL / "uofa" / each / "images" for each in ("day", "evening"))
    database, exported, place = tmp_path / "town", tmp_path / "town.npy", tmp_path / "place.onnx"
    given = ("--segmenter", network, "--segmenter-cache", tmp_path / "cache")
    own = ("--labels-as", SPACE, "--sequence", "day")
    assert ssrvlad("encode", day, "-o", database, *given, *own)[0] == 0
    ssrvlad("db", "export", database, "--format", "npy", "-o", exported)
    ssrvlad("fuse", network, "-o", place, "--labels-as", SPACE)
    followed = first(
        main_of(program.main, "x", place, evening, "--database", exported, "--json")[1]
    )
    same = []
    for options in ((), ("--no-sweep",)):
        query = first(ssrvlad("query", database, evening, *given, *options, "--json")[1])
        pairs = zip(followed.values(), query.values(), strict=True)
        same.append(sum(one["frame"] == other["frame"] for one, other in pairs))
    assert same == [150, 129]


def recall(found):
    rows = {frame.rpartition("/")[2]: row for row, frame in enumerate(found)}
    found = {query: each["frame"].rpartition("/")[2] for query, each in found.items()}
    return np.mean([abs(row - rows[found[q]]) <= 1 for row, q in enumerate(found)])
