"""The loop detector: its rules by hand; saving and loading; where a stream breaks."""

import math
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from helpers import refuses, street
from loop_streams import LIGHT, PLACES, RNG, drawn_anew, noisy_stream, unit, views  # noqa: F401

from ssrvlad_torch import SSRVLAD, Database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.datasets.synthetic_city import LEFT, STRAIGHT, SyntheticCity
from ssrvlad_torch.evaluation.loops import score_loops
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.detector import COLUMNS, LoopDetector
from ssrvlad_torch.loops.result import Reason

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")


def detector(**settings):
    return LoopDetector(LoopConfig(**settings), HEAD)


def show(loops, vectors, sequence="drive", poses=None):
    """Shows descriptors to a detector."""
    start, poses = len(loops), poses or [None] * len(vectors)
    return [
        loops.update(vector, f"{sequence}/{start + row}", pose=poses[row])
        for row, vector in enumerate(vectors)
    ]


@pytest.fixture
def database(tmp_path):
    return Database.create(tmp_path / "db", HEAD.config)


def reloaded(loops, database):
    """A detector that knows what this one saved."""
    return LoopDetector.load(Database.open(database.path), loops.config, HEAD)


def reasons(results):
    return [result.reason.value for result in results]


def row_of(frame):
    return int(frame.rpartition("/")[2])


def accepted(results):
    """Rows of the candidates of the frames that close loops, by the frames' rows."""
    return {row_of(r.frame): row_of(r.candidate) for r in results if r.accepted}


@pytest.mark.parametrize("second", [range(20, 80), range(20, 80, 2), [*range(20, 45), *[45] * 40]])
def test_places_seen_again_close_loops(second):
    """In the same order, at twice the speed, and standing still at one on the way."""
    results = show(detector(), views([*range(150), *second]))
    loops = accepted(results)
    assert min(loops) <= 165 and len(loops) >= len(second) - 15
    assert all(abs(there - second[here - 150]) <= 2 for here, there in loops.items())
    assert min(r.confidence for r in results if r.accepted) >= 0.8


def night_after_day(places):
    """Rows of loops of places of a night, by its frames, after a day of 150 places. All frames of
    the night differ from those of the day by more than places do."""
    loops = detector()
    assert not accepted(show(loops, views(range(150)), "day"))
    closed = accepted(show(loops, views(places, 0.02, LIGHT), "night"))
    return {row - 150: there for row, there in closed.items()}


def test_places_seen_again_in_other_light_close_loops():
    closed = night_after_day(range(40, 120))
    assert len(closed) > 50 and all(abs(n + 40 - there) <= 2 for n, there in closed.items())


def test_other_places_in_other_light_close_none():
    assert not night_after_day(range(160, 240))


def test_shuffled_frames_close_hardly_any_loop():
    """Frames that are no sequence, though each shows a place of the map by itself."""
    assert len(night_after_day(np.random.default_rng(1).permutation(150))) < 5


STANDING = [*range(100), *[100] * 200, *range(101, 140)]


@pytest.mark.parametrize(
    ("places", "exclude", "noise"),
    [(STANDING, 50, 0.0), (STANDING, 50, 0.002), ([*range(120), *range(60, 90)], 80, 0.002)],
)
def test_neither_standing_still_nor_an_excluded_frame_closes_a_loop(places, exclude, noise):
    """Standing at a new place, not even where the frames are equal to the last bit."""
    results = show(detector(exclude=exclude), views(places, noise))
    assert not accepted(results)
    assert exclude == 50 or "too_recent" in reasons(results)[120:]
    assert accepted(show(detector(), views([*range(120), *range(60, 90)])))


def test_two_places_alike_are_ambiguous_and_both_are_candidates():
    """For a back end that verifies; the first is the candidate of the result."""
    places = [*range(80), *range(20, 40), *range(80, 140), *range(20, 40)]
    results = show(detector(threshold=0.9), views(places))[160:]
    result = next(result for result in results if result.reason is Reason.AMBIGUOUS)
    first, second, *_ = result.candidates
    assert (first.frame, first.confidence) == (result.candidate, result.confidence)
    assert abs(row_of(first.frame) - row_of(second.frame)) == 60
    assert first.confidence >= second.confidence > 0.1
    assert result.as_json()["candidates"][1] == second._asdict()


def test_frames_of_another_sequence_are_never_too_recent():
    """Two short drives, all of it within what is excluded of one."""
    loops = detector(exclude=50)
    assert set(reasons(show(loops, views(range(30)), "monday"))) == {"no_candidate", "too_recent"}
    results = show(loops, views(range(30)), "tuesday")
    closed = accepted(results)
    assert len(closed) > 20 and all(there == here - 30 for here, there in closed.items())
    assert "too_recent" not in reasons(results)


def test_metres_ahead_of_the_candidate_by_poses():
    """The second lap stands half way between the frames of the first."""
    places = np.arange(100)
    first = views(places)
    halves = unit(first[20:60] + first[21:61])
    poses = [(2.0 * x, 0.0) for x in [*places, *(places[20:60] + 0.5)]]
    results = show(detector(), [*first, *halves], poses=poses)[115:]
    rows = [row_of(r.candidate) for r in results]
    stands = np.array([2.0 * row + r.ahead for row, r in zip(rows, results, strict=True)])
    truth = np.array([x for x, _ in poses[115:]])
    assert np.abs(stands - truth).mean() < np.abs(2.0 * np.array(rows) - truth).mean()
    without = show(detector(), [*first, *halves])
    assert {r.ahead for r in without} == {None}


def test_label_maps_scores_and_descriptors_are_the_same_frame():
    """Label maps are described from three anchors, and remembered from one."""
    maps = [street(seed) % 11 for seed in range(4)]
    loops, swept = detector(exclude=0), detector(exclude=0)
    for number, labels in enumerate(maps):
        [anchors] = HEAD.sweep(labels[None], COLUMNS)
        one_hot = torch.nn.functional.one_hot(torch.from_numpy(labels).long(), 11)
        got = loops.update(one_hot.permute(2, 0, 1).float(), f"drive/{number}")
        assert got == swept.observe(FrameRecord("drive", str(number)), anchors)
    plain = LoopDetector(LoopConfig(sweep=False), HEAD)
    assert (loops.columns, plain.columns) == (COLUMNS, ())
    assert LoopDetector(head=SSRVLAD.from_preset("paper")).columns == ()


BAD_FRAMES = {
    "frame 'drive/3' was there before": (PLACES[0], "drive/3"),
    "id <sequence>/<name>, got '000007'": (PLACES[0], "000007"),
    "frame id, <sequence>/<name> or <name>, got 'drive/ 7'": (PLACES[0], "drive/ 7"),
    r"ssr-vlad: expected an array \(1, 480\) .*, got \(1, 9\)": (PLACES[0, :9], "drive/a"),
    "'drive/a': expected finite vectors of length 1 or 0": (2 * PLACES[0], "drive/a"),
    "77": (np.full((9, 9), 77), "drive/a"),
    r"expected a stamp from 4\.0 on, got 3\.9": (PLACES[0], "drive/a", 3.9),
    "features as a tensor or an array, got str": (PLACES[0], "drive/a", 5.0, None, None, "x"),
    "stamp in seconds, got '7'": (PLACES[0], "drive/a", "7"),
    "finite x, y, heading, got .*inf": (PLACES[0], "drive/a", 5.0, (1.0, math.inf)),
}


@pytest.mark.parametrize("message", BAD_FRAMES)
def test_a_frame_that_is_refused_leaves_no_trace(message):
    loops, spared = detector(exclude=1), detector(exclude=1)
    for stream in (loops, spared):
        for number in range(5):
            stream.update(PLACES[number], f"drive/{number}", float(number))
    refuses(message, loops.update, *BAD_FRAMES[message])
    assert (len(loops), "drive/a" in loops) == (5, False)
    assert loops.update(PLACES[1], "drive/z", 6.0) == spared.update(PLACES[1], "drive/z", 6.0)


def test_a_stamp_must_not_go_back_in_its_sequence(database):
    loops = detector()
    loops.update(PLACES[0], "drive/0", 5.0)
    loops.update(PLACES[1], "drive/1")
    loops.update(PLACES[2], "another/0", 4.0)
    loops.save(database)
    for stream in (loops, reloaded(loops, database)):
        with pytest.raises(ValueError, match=r"expected a stamp from 5\.0 on, got 4\.5"):
            stream.update(PLACES[2], "drive/2", 4.5)


def test_a_checkpoint_is_an_ordinary_database(database):
    loops, maps = detector(), [street(seed) for seed in range(6)]
    for number, labels in enumerate(maps):
        loops.update(labels, f"drive/{number}", stamp=number, pose=(number, 0, 1))
        if number in (2, 5):
            loops.save(database)
    stored = Database.open(database.path).load()
    alone = HEAD(torch.from_numpy(np.stack(maps)))
    torch.testing.assert_close(stored.descriptors, alone, rtol=0, atol=1e-6)
    assert stored.poses[:, 0].tolist() == stored.stamps.tolist() == [*range(6)]
    for number, labels in enumerate(maps):
        record = database.known()[f"drive/{number}"]
        assert (record.digest, record.height, record.width) == (digest(labels), 24, 32)


def test_frames_come_back_in_the_order_in_which_they_came_whatever_their_names(database):
    vectors = views([*range(100), *range(20, 60)])
    names = np.random.default_rng(0).permutation(1000)[:140].tolist()
    database.append([f"before/{n}" for n in (2, 10, 1)], views(range(3)))
    loops = LoopDetector.load(database, LoopConfig(exclude=30), HEAD)
    for number, vector in enumerate(vectors[:100]):
        loops.update(vector, f"{'ba'[number >= 15]}/{names[number]}")
        if number == 40:
            loops.save(database)
    loops.save(database)
    encoded = FrameRecord("a", str(names[70]), signature="folder|state")
    database.merge([encoded], torch.from_numpy(vectors[70:71]))
    loaded = reloaded(loops, database)
    expected = [f"before/{n}" for n in (1, 2, 10)]
    expected += [f"{'ba'[n >= 15]}/{names[n]}" for n in range(100)]
    assert loaded.frames == expected
    went_on = show(loaded, vectors[100:], "c")
    assert [r.candidate for r in went_on[20:]] == expected[3 + 40 : 3 + 60]


def test_a_memory_whose_frames_were_removed_or_encoded_anew_is_gone_on_from(database):
    vectors = views([*range(100), *range(20, 60)])
    loops = detector()
    show(loops, vectors[:100])
    loops.save(database)
    database.remove([f"drive/{n}" for n in range(5)])
    database.merge([FrameRecord("drive", "30")], torch.from_numpy(vectors[110:111]))
    loaded = reloaded(loops, database)
    assert loaded.frames == [f"drive/{n}" for n in range(5, 100)]
    assert accepted(loaded.update(v, f"again/{n}") for n, v in enumerate(vectors[100:]))[20] == 40
    loaded.save(Database.open(database.path))
    assert len(Database.open(database.path)) == 135


def test_a_foreign_database_is_refused(tmp_path):
    loops = detector()
    show(loops, views(range(3)))
    other = Database.create(tmp_path / "other", SSRVLAD.from_preset("paper").config)
    for use in (loops.save, lambda database: LoopDetector.load(database, head=HEAD)):
        refuses("has fingerprint", use, other)
    filled = Database.create(tmp_path / "filled", HEAD.config)
    filled.append([FrameRecord("map", "0")], torch.from_numpy(PLACES[:1]))
    refuses("with no frame, got one of 1 frames", loops.save, filled)


def test_one_updates_while_another_saves(database):
    swept, sequences = noisy_stream(8, 400, 40, [150, 300])

    def show(loops):
        named = zip(swept[:, 0], sequences, strict=True)
        return [loops.update(v, f"{name}/{n:03d}") for n, (v, name) in enumerate(named)]

    loops, done = detector(), threading.Event()

    def save():
        while not done.is_set():
            loops.save(database)

    with ThreadPoolExecutor(1) as pool:
        saved = pool.submit(save)
        try:
            results = show(loops)
        finally:
            done.set()
    assert saved.result() is None
    assert results == show(detector())
    loops.save(database)
    assert LoopDetector.load(Database.open(database.path), head=HEAD).frames == loops.frames


def city_loops(seed, turns, frames, estates=()):
    """The row of the candidate of each frame of a drive, -1 for none, and the frames' poses."""
    head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
    made = list(SyntheticCity(seed, estates).traverse(frames, size=(60, 80), turns=turns))
    labels = torch.from_numpy(np.stack([frame.labels for frame in made]))
    closed = accepted(show(detector(), torch.cat([*map(head, labels.split(16))])))
    rows = np.array([closed.get(row, -1) for row in range(len(made))])
    return rows, np.array([frame.pose for frame in made])


def test_a_street_that_looks_alike_all_along_closes_no_loop():
    """The same houses block after block, 380 m long."""
    assert (city_loops(1, [STRAIGHT] * 5, 130, estates=(0,))[0] == -1).all()


def test_the_second_time_round_a_block_closes_loops_and_only_right_ones():
    rows, poses = city_loops(1, [LEFT] * 8, 220)
    score = score_loops(rows, poses, LoopConfig.exclude, metres=10.0)
    assert score.precision == 1
    assert score.revisits > 80 and score.recall > 0.2


# ---- where a stream breaks, and what is recognised across

HOUR = 3600.0
BETWEEN = PLACES + np.roll(PLACES, -1, axis=0)
"""Descriptors of places, each half like the next."""


def views_between(places, noise=0.002, light=0.0):
    vectors = BETWEEN[np.asarray(places)] + light
    return unit(vectors + RNG.normal(0, noise, vectors.shape))


DAY, NIGHT = views_between(range(150)), views_between(range(40, 120), 0.02, LIGHT)


def night_after(frames, step, pause, name="day"):
    """The results of a night, three frames a second, after some frames of a day and a pause."""
    loops = detector()
    for row, vector in enumerate(DAY[:frames]):
        loops.update(vector, f"day/{row}", row * step)
    later = (frames - 1) * step + pause
    return [loops.update(v, f"{name}/{frames + n}", later + n / 3) for n, v in enumerate(NIGHT)]


@pytest.mark.parametrize(
    ("frames", "step", "pause", "breaks"),
    [
        (150, 1 / 3, 700.0, True),
        (150, 1 / 3, 500.0, False),  # the light is still the same
        (19, 1 / 3, HOUR, False),  # too few frames to know what is usual
        (150, 0.3 * HOUR, HOUR, False),  # a frame in twenty minutes
        (150, math.nan, HOUR, False),
    ],
)
def test_a_gap_is_long_for_light_and_for_the_stream(frames, step, pause, breaks):
    """Where a stream breaks, what comes is as of another sequence."""
    day, night = (
        [(r.reason, r.candidate, r.confidence) for r in night_after(frames, step, pause, name)]
        for name in ("day", "night")
    )
    assert (day == night) == breaks


def test_after_a_gap_another_light_closes_loops_and_without_one_none():
    assert len(accepted(night_after(150, 1 / 3, HOUR))) > 50
    assert not accepted(night_after(150, 1 / 3, 1.3))


@pytest.mark.parametrize("stop", [149, 150, 151, 200])
def test_a_stream_that_was_saved_goes_on_as_one_that_was_not(database, stop):
    """Just before a gap, at it, just after it, and later."""
    vectors = np.concatenate((DAY, NIGHT))
    stamps = np.concatenate((np.arange(150) / 3, HOUR + np.arange(80) / 3))

    def go(loops, rows):
        return [loops.update(vectors[n], f"drive/{n}", stamps[n]) for n in rows]

    expected, stopped = go(detector(sweep=False), range(230)), detector(sweep=False)
    results = go(stopped, range(stop))
    stopped.save(database)
    results += go(reloaded(stopped, database), range(stop, 230))
    for result, whole in zip(results, expected, strict=True):
        assert (result.reason, result.candidate) == (whole.reason, whole.candidate)
        assert (result.confidence or 0) == pytest.approx(whole.confidence or 0, abs=0.01)
    assert len(accepted(results)) > 50


def alike(start, styles, strength=0.8, light=0.0):
    """Descriptors of new places, which are like those of the same style, but less than a frame is
    like the next."""
    vectors = BETWEEN[start : start + len(styles)] + strength * BETWEEN[styles]
    noise = RNG.normal(0, 0.3 / 22, vectors.shape)
    return unit(unit(vectors + light) + noise)


def test_places_no_more_alike_than_those_of_the_stream_close_no_loop():
    """A street of two parts that are alike, and a third; by another name, a street like the third;
    and last the third itself, in another light."""
    first, third, loops = np.arange(300, 380), np.arange(380, 460), detector()
    show(loops, [*alike(0, first), *alike(80, first), *alike(160, third)], "first")
    assert not accepted(show(loops, alike(240, third[:60], 0.6), "second"))
    assert len(accepted(show(loops, alike(160, third, light=0.2 * LIGHT), "third"))) > 50
