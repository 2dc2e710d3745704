"""The program that finds drives without torch, against the command line."""

import json
from functools import partial

import follow_onnx as program
import numpy as np
import pytest
import run_onnx
import torch
from cases import REAL, needs_real
from helpers import street
from networks import photo
from segmenting import write_drives, write_image, write_town
from test_fusion import TRUST

from ssrvlad_torch import SSRVLADConfig, export_head
from ssrvlad_torch.channels.signs import SignQueries, SignRows
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.recognition.fusion import FusedScores
from ssrvlad_torch.recognition.standardise import standardise
from ssrvlad_torch.stages.features import SHAPE

SPACE = "cityscapes-trainids"
MEMBERS = ("ssr-vlad", "features")

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture
def town(ssrvlad, tmp_path):
    """A function that stores a map, and its files: of the head, and of the descriptors."""

    def store(*maps):
        database, exported = tmp_path / "town", tmp_path / "town.npy"
        assert ssrvlad("encode", *maps, "-o", database, "--labels-as", SPACE)[0] == 0
        assert ssrvlad("db", "export", database, "--format", "npy", "-o", exported)[0] == 0
        export_head(SSRVLADConfig(labels_as=SPACE), tmp_path / "head.onnx", dtype="int64")
        return database, tmp_path / "head.onnx", exported

    return store


def first(out):
    lines = [json.loads(line) for line in out.splitlines()]
    return {line["query"]: line["candidates"][0] for line in lines}


def test_a_drive_is_found_as_by_query(main_of, ssrvlad, town, tmp_path):
    """In a map of two drives, one of them of another city."""
    city = write_city(tmp_path / "city", frames=40, size=(60, 80), seed=3)
    other = write_city(tmp_path / "b", frames=12, size=(60, 80), seed=1)
    database, head, exported = town(city.reference, other.reference.rename(tmp_path / "other"))
    code, out, err = main_of(
        program.main, "follow_onnx.py", head, city.query, "--database", exported, "--json"
    )
    assert (code, err) == (0, [])
    expected = ssrvlad("query", database, city.query, "--no-sweep", "--json")[1].splitlines()
    lines = (map(json.loads, each) for each in (out.splitlines(), expected))
    for line, right in zip(*lines, strict=True):
        assert (line["query"], line["empty"]) == (right["query"], False)
        (frame, score), (frame_expected, score_expected) = (
            each["candidates"][0].values() for each in (line, right)
        )
        assert frame == frame_expected
        assert abs(score - score_expected) < 1e-3


def test_scores_of_features_and_weights_are_those_of_query():
    """Of a drive of which the leads are known, and of one that is too short."""
    rng = np.random.default_rng(0)
    signs = rng.integers(0, 256, (80, *SHAPE), np.uint8)
    signs[40:] = np.where(rng.random(signs[40:].shape) < 0.6, np.roll(signs[:40], 1, 1), signs[40:])
    references, queries = signs[:40], signs[40:]
    cosines = rng.uniform(-1, 1, (40, 40)).astype(np.float32)
    cosines[3], cosines[:, 5] = -np.inf, -np.inf
    for frames in (40, 20):
        names, whole = ["a"] * frames, frames == 40
        rows = SignRows(torch.from_numpy(references), ["b"] * 40 if whole else None)
        expected = SignQueries(torch.from_numpy(queries[:frames]), rows, whole).scores()
        got = program.scores_of_signs(
            program.numbers(queries[:frames], names, whole),
            program.numbers(references, ["b"] * 40, whole),
        )
        np.testing.assert_allclose(got, expected, atol=1e-5)
        both = [cosines[:frames], got]
        members = {name: torch.from_numpy(v) for name, v in zip(MEMBERS, both, strict=True)}
        fused = FusedScores(members, TRUST)
        leads = [program.mean_lead(each) if whole else 0.0 for each in both]
        weights = program.weights_of(dict(zip(MEMBERS, leads, strict=True)))
        np.testing.assert_allclose(weights, [*fused.weights.values()], atol=1e-5)
        for row, right in zip(zip(*both, strict=True), fused.whole(), strict=True):
            np.testing.assert_allclose(program.fused(row, weights), right, atol=1e-5)


def test_a_drive_with_features_is_found(main_of, tmp_path):
    """By the features: the label maps are of random scores."""
    write_drives(tmp_path, range(36), range(2, 35), (96, 128))
    write_town(tmp_path, tmp_path / "town.npy")
    given = (tmp_path / "today", "--database", tmp_path / "town.npy", "--json")
    code, out, err = main_of(program.main, "follow_onnx.py", tmp_path / "place.onnx", *given)
    assert (code, err) == (0, [])
    found = first(out)
    right = [each["frame"].replace("monday", "today") == query for query, each in found.items()]
    assert np.mean(right) > 0.9


def test_with_all_channels_it_gives_the_rows_of_query_not_those_without_a_sweep(
    main_of, ssrvlad, tmp_path
):
    """It moves features to both sides, as `query` does; these pictures look two cells aside."""
    write_drives(tmp_path, range(36), (), (96, 128))
    for seed in range(2, 35):
        pixels = np.roll(photo(street(seed, 96, 128)), 14, axis=1)
        write_image(tmp_path / "today" / f"{seed}.png", pixels)
    database, exported = tmp_path / "town", tmp_path / "town.npy"
    network = ("--segmenter", tmp_path / "net.yaml", "--labels-as", "camvid-11")
    ssrvlad("encode", tmp_path / "monday", "-o", database, *network)
    ssrvlad("db", "export", database, "--format", "npy", "-o", exported)
    given = (tmp_path / "place.onnx", tmp_path / "today", "--database", exported, "--json")
    got = first(main_of(program.main, "follow_onnx.py", *given)[1])
    query = ("query", database, tmp_path / "today", *network[:2], "--json")
    same, still = (first(ssrvlad(*query, *options)[1]) for options in ((), ("--no-sweep",)))
    assert len(got) == 33 and [*got] == [*same]
    for frame, candidate in got.items():
        assert candidate["frame"] == same[frame]["frame"] == frame.replace("today", "monday")
        assert candidate["score"] == pytest.approx(same[frame]["score"], abs=1e-4)
    assert np.mean([got[frame]["frame"] == still[frame]["frame"] for frame in got]) < 0.5


@pytest.mark.parametrize("frames", [(40,), (12, 40), (5, 6), (20, 20)])
def test_means_are_those_of_standardise(frames):
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(sum(frames), 48)).astype(np.float32) + 1
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors[1] = 0
    names = [str(number) for number, count in enumerate(frames) for _ in range(count)]
    got = program.without_means(vectors, names)[:, 0]
    np.testing.assert_allclose(got, standardise(vectors, names).numpy(), atol=1e-5)


def test_wrong_use_is_one_line(main_of, town, tmp_path):
    city = write_city(tmp_path / "city", frames=2, size=(60, 80))
    _, head, exported = town(city.reference)
    follow = partial(main_of, program.main, "follow_onnx.py", head)
    (tmp_path / "empty").mkdir()
    for folder, problem in (("none", "does not exist"), ("empty", "holds no frames")):
        code, _, err = follow(tmp_path / folder, "--database", exported)
        assert (code, len(err)) == (2, 1) and problem in err[0]
    np.save(tmp_path / "none.npy", np.zeros((0, 480), np.float32))
    (tmp_path / "none.npy.frames.txt").touch()
    code, _, err = follow(city.query, "--database", tmp_path / "none.npy")
    assert code == 2 and err[-1] == f"follow_onnx: {tmp_path / 'none.npy'} holds no frames"
    np.save(tmp_path / "void.npy", np.zeros((2, 480), np.float32))
    (tmp_path / "void.npy.frames.txt").write_text("a/0\na/1\n")
    code, out, _ = follow(city.query, "--database", tmp_path / "void.npy", "--json")
    assert code == 0
    for line in map(json.loads, out.splitlines()):
        assert (line["candidates"], line["empty"]) == ([], False)
    (city.query / "torn.png").write_bytes(b"torn")
    code, out, err = follow(city.query, "--database", exported)
    assert (code, out.count("\n"), err[-1]) == (3, 2, "skipped 1 of 3 frames")


@pytest.mark.slow
@needs_real
def test_what_following_is_worth(main_of, ssrvlad, town):
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
def test_what_features_change(main_of, ssrvlad, tmp_path):
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
