"""The loop detector: its rules by hand, its filter against `Filter`, saving and loading."""

import math
import threading

import numpy as np
import pytest
import torch
from helpers import street
from loop_streams import PLACES, noisy_stream

from ssrvlad_torch import SSRVLAD, Database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.datasets.synthetic_city import LEFT, STRAIGHT, SyntheticCity
from ssrvlad_torch.evaluation.loops import score_loops
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.detector import COLUMNS, LoopDetector
from ssrvlad_torch.loops.result import Reason

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
RNG = np.random.default_rng(0)


def views(places, noise=0.002):
    """Descriptors of places, each a little different."""
    vectors = PLACES[np.asarray(places)] + RNG.normal(0, noise, (len(places), 480))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def lit(places, light):
    """Descriptors of places that have something in common."""
    vectors = PLACES[np.asarray(places)] + light + RNG.normal(0, 0.02, (len(places), 480))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def detector(**settings):
    return LoopDetector(LoopConfig(**settings), HEAD)


def drive(loops, vectors, sequence="drive", poses=None):
    """Shows descriptors to a detector."""
    return [
        loops.update(vector, f"{sequence}/{number}", pose=None if poses is None else poses[row])
        for row, (number, vector) in enumerate(enumerate(vectors, len(loops)))
    ]


def reasons(results):
    return [result.reason.value for result in results]


def accepted(results):
    """Rows of the candidates of the frames that close loops, by the frames' rows."""
    numbers = [
        [int(frame.rpartition("/")[2]) for frame in (r.frame, r.candidate)]
        for r in results
        if r.accepted
    ]
    return dict(numbers)


def test_the_first_frames_have_nothing_to_compare_with():
    loops = detector(exclude=5)
    assert repr(loops).startswith("LoopDetector(0 frames, LoopConfig(")
    results = drive(loops, views(range(8)))
    assert repr(loops).startswith("LoopDetector(8 frames, last drive/7, LoopConfig(exclude=5")
    assert reasons(results) == ["no_candidate", *["too_recent"] * 6, "below_threshold"]
    assert results[6]._replace(frame="") == ("", Reason.TOO_RECENT, None, None, None, None)


@pytest.mark.parametrize(
    ("second", "step"),
    [(range(20, 80), 1), (range(20, 80, 2), 2), ([*range(20, 45), *[45] * 40], 0)],
)
def test_places_seen_again_close_loops(second, step):
    """In the same order, at twice the speed, and standing still at one on the way."""
    results = drive(detector(), views([*range(150), *second]))
    loops = accepted(results)
    assert min(loops) <= 165
    assert len(loops) >= len(second) - 15
    assert all(abs(there - second[here - 150]) <= 2 for here, there in loops.items())
    assert {r.probability >= 0.8 for r in results if r.accepted} == {True}


def test_places_seen_again_in_other_light_close_loops_and_other_places_do_not():
    """All frames of the second drive differ from those of the first by more than places do."""
    light = 3 * PLACES[-1]
    results = drive(detector(), views(range(150)), "day")
    loops, other = detector(), detector()
    for each in (loops, other):
        drive(each, views(range(150)), "day")
    seen = drive(loops, lit(range(40, 120), light), "night")
    found = {n: int(r.candidate.rpartition("/")[2]) - 40 for n, r in enumerate(seen) if r.accepted}
    assert len(found) > 50 and all(abs(n - there) <= 2 for n, there in found.items())
    assert not any(
        r.accepted for r in [*results, *drive(other, lit(range(160, 240), light), "night")]
    )


def test_shuffled_frames_close_no_wrong_loop():
    """Frames that are no sequence, though each shows a place of the map by itself."""
    loops = detector()
    drive(loops, views(range(150)), "day")
    order = np.random.default_rng(1).permutation(150)
    results = drive(loops, lit(order, 3 * PLACES[-1]), "night")
    pairs = [
        (r.candidate, f"day/{there}") for r, there in zip(results, order, strict=True) if r.accepted
    ]
    assert len(pairs) < 5 and all(found == there for found, there in pairs)


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_standing_still_at_a_new_place_closes_no_loop(noise):
    """Not even where the frames are equal to the last bit."""
    places = [*range(100), *[100] * 200, *range(101, 140)]
    assert not accepted(drive(detector(), views(places, noise)))


def test_the_excluded_frames_are_no_candidates():
    results = drive(detector(exclude=80), views([*range(120), *range(60, 90)]))
    assert not accepted(results)
    assert "too_recent" in reasons(results)[120:]
    assert accepted(drive(detector(exclude=50), views([*range(120), *range(60, 90)])))


def test_the_descriptor_of_the_last_frame():
    """That of the usual anchor, though it was seen from several."""
    loops = detector()
    with pytest.raises(IndexError, match="no frame was seen yet"):
        _ = loops.descriptor
    for seed in range(2):
        labels = torch.from_numpy(street(seed))
        loops.update(labels, f"drive/{seed}")
        np.testing.assert_allclose(loops.descriptor, HEAD(labels[None])[0], atol=1e-6)


def test_an_empty_frame_matches_nothing_and_the_stream_goes_on():
    vectors = views([*range(100), *range(20, 50)])
    vectors[[30, 115]] = 0
    results = drive(detector(), vectors)
    assert results[115][1:3] == (Reason.EMPTY_FRAME, None)
    assert accepted(results)[116] == 36
    assert 30 not in accepted(results).values()
    assert reasons(drive(detector(), np.zeros((3, 480), np.float32))) == ["empty_frame"] * 3
    assert reasons(drive(detector(), [vectors[30], vectors[0]]))[1] == "no_candidate"


def test_two_places_alike_are_ambiguous():
    places = [*range(80), *range(20, 40), *range(80, 140), *range(20, 40)]
    vectors = views(places)
    results = drive(detector(threshold=0.9), vectors)
    assert "ambiguous" in reasons(results)[160:]


def test_clear_frames_must_fit_better_than_noisy_ones():
    """A second street is like the first in half of what it shows. Where neighbouring frames are
    nearly equal it is another one, and where noise leaves them half alike it is the first."""
    first, other = blurred(range(90)), blurred(range(200, 290))
    similar = [unit(one + math.sqrt(3) * two) for one, two in zip(first, other, strict=True)]
    assert not accepted(drive(detector(), [*first, *similar]))
    noise = np.random.default_rng(1).normal(0, math.sqrt(1 / 480), (180, 480))
    again = [unit(one + noisy) for one, noisy in zip([*first, *first], noise, strict=True)]
    found = accepted(drive(detector(), again))
    assert len(found) > 30 and all(abs(row - 90 - there) <= 3 for row, there in found.items())


def blurred(places):
    """Descriptors of places that neighbouring places share most of."""
    return [
        unit(sum(math.exp(-(k**2) / 8) * PLACES[at + k] for k in range(-6, 7))) for at in places
    ]


def unit(vector):
    return (vector / np.linalg.norm(vector)).astype(np.float32)


def test_another_sequence_looks_for_its_place_anew():
    loops = detector(exclude=0)
    drive(loops, views(range(100)), "monday")
    first = drive(loops, views(range(40, 60)), "tuesday")
    assert reasons(first)[0] == "below_threshold"
    assert set(reasons(first)[5:]) == {"accepted"}
    assert reasons(drive(loops, views(range(60, 62)), "wednesday"))[0] == "below_threshold"


def test_metres_ahead_of_the_candidate_by_poses():
    """The second lap stands half way between the frames of the first."""
    places = np.arange(100)
    first = views(places)
    halves = first[20:60] + first[21:61]
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    poses = [(2.0 * x, 0.0) for x in [*places, *(places[20:60] + 0.5)]]
    results = drive(detector(), [*first, *halves], poses=poses)[115:]
    rows = [int(r.candidate.rpartition("/")[2]) for r in results]
    stands = np.array([2.0 * row + r.ahead for row, r in zip(rows, results, strict=True)])
    truth = np.array([x for x, _ in poses[115:]])
    off = np.abs(2.0 * np.array(rows) - truth)
    assert np.abs(stands - truth).mean() < off.mean()
    without = drive(detector(), [*first, *halves])
    assert {r.ahead for r in without} == {None}


def test_label_maps_scores_and_descriptors_are_the_same_frame():
    """Label maps are described from three anchors, and remembered from one."""
    maps = [street(seed) % 11 for seed in range(4)]
    loops, swept = detector(exclude=0), detector(exclude=0)
    for number, labels in enumerate(maps):
        record = FrameRecord("drive", str(number))
        views_of = HEAD.sweep(labels[None], COLUMNS)[0]
        one_hot = torch.nn.functional.one_hot(torch.from_numpy(labels).long(), 11)
        got = loops.update(one_hot.permute(2, 0, 1).float(), f"drive/{number}")
        assert got == swept.observe(record, views_of)
    plain = LoopDetector(LoopConfig(sweep=False), HEAD)
    assert (loops.columns, plain.columns) == (COLUMNS, ())
    assert LoopDetector(head=SSRVLAD.from_preset("paper")).columns == ()


BAD_FRAMES = {
    "frame 'drive/3' was there before": lambda loops: loops.update(PLACES[0], "drive/3"),
    "id <sequence>/<name>, got '000007'": lambda loops: loops.update(PLACES[0], "000007"),
    "id <sequence>/<name>, got 'drive/'": lambda loops: loops.update(PLACES[0], "drive/"),
    r"expected a descriptor \(480,\).* got \(9,\)": lambda loops: loops.update(
        PLACES[0, :9], "drive/a"
    ),
    "length 1 or zero, got nan": lambda loops: loops.update(
        np.full(480, np.nan, np.float32), "drive/a"
    ),
    "length 1 or zero, got 2": lambda loops: loops.update(2 * PLACES[0], "drive/a"),
    "77": lambda loops: loops.update(np.full((9, 9), 77), "drive/a"),
    "class scores must be floating point": lambda loops: loops.update(
        np.zeros((2, 9, 9), int), "drive/a"
    ),
    r"expected a stamp from 4\.0 on, got 3\.9": lambda loops: loops.update(
        PLACES[0], "drive/a", stamp=3.9
    ),
    "stamp from 4.0 on, got inf": lambda loops: loops.update(PLACES[0], "drive/a", stamp=math.inf),
    r"stamp in seconds, got '7'": lambda loops: loops.update(PLACES[0], "drive/a", stamp="7"),
    r"x, y, heading, got \(None, 1\)": lambda loops: loops.update(
        PLACES[0], "drive/a", 5.0, pose=(None, 1)
    ),
    r"x, y, heading, got \(1, nan\)": lambda loops: loops.update(
        PLACES[0], "drive/a", 5.0, pose=(1, math.nan)
    ),
    r"expected a pose of finite x, y, heading, got \[1.0\]": lambda loops: loops.update(
        PLACES[0], "drive/a", 5.0, pose=[1.0]
    ),
    "finite x, y, heading, got '12'": lambda loops: loops.update(
        PLACES[0], "drive/a", 5.0, pose="12"
    ),
    "finite x, y, heading, got .*inf": lambda loops: loops.update(
        PLACES[0], "drive/a", 5.0, pose=(1.0, math.inf)
    ),
}


@pytest.mark.parametrize("message", BAD_FRAMES)
def test_a_frame_that_is_refused_leaves_no_trace(message):
    loops, spared = detector(exclude=1), detector(exclude=1)
    for each in (loops, spared):
        for number in range(5):
            each.update(PLACES[number], f"drive/{number}", float(number))
    with pytest.raises(ValueError, match=message) as caught:
        BAD_FRAMES[message](loops)
    assert "\n" not in str(caught.value)
    assert (len(loops), "drive/a" in loops) == (5, False)
    after = [each.update(PLACES[1], "drive/z", 6.0) for each in (loops, spared)]
    assert after[0] == after[1]


def test_a_stamp_must_not_go_back_in_its_sequence(tmp_path):
    loops = detector()
    loops.update(PLACES[0], "drive/0", 5.0)
    loops.update(PLACES[1], "drive/1")
    with pytest.raises(ValueError, match=r"expected a stamp from 5\.0 on, got 4\.0"):
        loops.update(PLACES[2], "drive/2", 4.0)
    loops.update(PLACES[2], "another/0", 4.0)
    database = Database.create(tmp_path / "db", HEAD.config)
    loops.save(database)
    loaded = LoopDetector.load(database, head=HEAD)
    for each in (loops, loaded):
        with pytest.raises(ValueError, match=r"expected a stamp from 5\.0 on, got 4\.5"):
            each.update(PLACES[2], "drive/2", 4.5)


def test_mirrored_arrays_are_label_maps_too():
    loops, labels = detector(), street(3)
    mirrored = loops.update(np.asarray(labels)[:, ::-1], "drive/0")
    assert mirrored.reason is Reason.NO_CANDIDATE
    expected = loops.head(np.ascontiguousarray(np.asarray(labels)[:, ::-1])[None])[0]
    assert np.array_equal(loops.descriptor, expected.numpy())


def test_a_checkpoint_is_an_ordinary_database(tmp_path):
    database = Database.create(tmp_path / "db", HEAD.config)
    loops = detector()
    maps = [street(seed) for seed in range(6)]
    for number, labels in enumerate(maps):
        loops.update(labels, f"drive/{number}", stamp=number, pose=(number, 0, 1))
        if number in (2, 5):
            loops.save(database)
    loops.save(database)
    stored = Database.open(database.path).load()
    alone = HEAD(torch.from_numpy(np.stack(maps)))
    torch.testing.assert_close(stored.descriptors, alone, rtol=0, atol=1e-6)
    assert stored.poses[:, 0].tolist() == stored.stamps.tolist() == [*range(6)]
    for number, labels in enumerate(maps):
        known = database.known()[f"drive/{number}"]
        assert (known.digest, known.height, known.width) == (digest(labels), 24, 32)


def test_each_frame_is_held_once(tmp_path):
    """Whether it is ever saved or not."""
    loops = detector()
    drive(loops, views(range(40)))
    assert all(isinstance(record, FrameRecord) for record in loops._unsaved)
    loops.save(Database.create(tmp_path / "db", HEAD.config))
    assert loops._unsaved == []


def test_a_loaded_detector_knows_all_frames_and_looks_for_its_place_anew(tmp_path):
    vectors = views([*range(100), *range(20, 60)])
    database = Database.create(tmp_path / "db", HEAD.config)
    loops = detector()
    drive(loops, vectors[:120])
    loops.save(database)
    loaded = LoopDetector.load(Database.open(database.path), loops.config, HEAD)
    assert (loaded.frames, len(loaded)) == (loops.frames, 120)
    went_on, anew = drive(loops, vectors[120:]), drive(loaded, vectors[120:])
    assert anew[0].reason is Reason.BELOW_THRESHOLD
    assert [r[:3] for r in anew[10:]] == [r[:3] for r in went_on[10:]]
    assert set(reasons(anew[10:])) == {"accepted"}


def test_frames_come_back_in_the_order_in_which_they_came_whatever_their_names(tmp_path):
    vectors = views([*range(100), *range(20, 60)])
    names = np.random.default_rng(0).permutation(1000)[:140].tolist()
    database = Database.create(tmp_path / "db", HEAD.config)
    database.append([f"before/{n}" for n in (2, 10, 1)], views(range(3)))
    loops = LoopDetector.load(database, LoopConfig(exclude=30), HEAD)
    for number, vector in enumerate(vectors[:100]):
        loops.update(vector, f"{'ba'[number >= 15]}/{names[number]}")
        if number == 40:
            loops.save(database)
    loops.save(database)
    encoded = FrameRecord("a", str(names[70]), signature="folder|state")
    database.merge([encoded], torch.from_numpy(vectors[70:71]))
    loaded = LoopDetector.load(Database.open(database.path), loops.config, HEAD)
    expected = [f"before/{n}" for n in (1, 2, 10)]
    expected += [f"{'ba'[n >= 15]}/{names[n]}" for n in range(100)]
    assert loaded.frames == expected
    went_on = [loaded.update(v, f"c/{n}") for n, v in enumerate(vectors[100:])]
    assert [r.candidate for r in went_on[20:]] == expected[3 + 40 : 3 + 60]


def test_a_memory_whose_frames_were_removed_or_encoded_anew_is_gone_on_from(tmp_path):
    vectors = views([*range(100), *range(20, 60)])
    database = Database.create(tmp_path / "db", HEAD.config)
    loops = detector()
    drive(loops, vectors[:100])
    loops.save(database)
    database.remove([f"drive/{n}" for n in range(5)])
    database.merge([FrameRecord("drive", "30")], torch.from_numpy(vectors[110:111]))
    loaded = LoopDetector.load(Database.open(database.path), loops.config, HEAD)
    assert loaded.frames == [f"drive/{n}" for n in range(5, 100)]
    assert accepted(loaded.update(v, f"again/{n}") for n, v in enumerate(vectors[100:]))[20] == 40
    loaded.save(Database.open(database.path))
    assert len(Database.open(database.path)) == 135


def test_a_foreign_database_is_refused(tmp_path):
    loops = detector()
    drive(loops, views(range(3)))
    other = Database.create(tmp_path / "other", SSRVLAD.from_preset("paper").config)
    with pytest.raises(ValueError, match="has fingerprint"):
        loops.save(other)
    with pytest.raises(ValueError, match="has fingerprint"):
        LoopDetector.load(other, head=HEAD)
    filled = Database.create(tmp_path / "filled", HEAD.config)
    filled.append([FrameRecord("map", "0")], torch.from_numpy(PLACES[:1]))
    with pytest.raises(ValueError, match="holds 1 frames; 0 of this stream were saved"):
        loops.save(filled)


def test_a_disk_that_refuses_loses_nothing(tmp_path, monkeypatch):
    database = Database.create(tmp_path / "db", HEAD.config)
    loops = detector()
    drive(loops, views(range(4)))

    def full(*_):
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Database, "append", full)
        with pytest.raises(OSError, match="no space"):
            loops.save(database)
    drive(loops, views(range(4, 6)))
    loops.save(database)
    assert Database.open(database.path).load().frames == tuple(f"drive/{n}" for n in range(6))


def test_one_updates_while_another_saves(tmp_path):
    swept, sequences = noisy_stream(8, 400, 40, [150, 300])
    database = Database.create(tmp_path / "db", HEAD.config)

    def show(loops):
        named = zip(swept[:, 0], sequences, strict=True)
        return [loops.update(v, f"{name}/{n:03d}") for n, (v, name) in enumerate(named)]

    loops, done, errors = detector(), threading.Event(), []

    def save():
        try:
            while not done.is_set():
                loops.save(database)
        except BaseException as error:
            errors.append(error)
            raise

    saver = threading.Thread(target=save)
    saver.start()
    results = show(loops)
    done.set()
    saver.join()
    assert not errors
    assert results == show(detector())
    loops.save(database)
    assert LoopDetector.load(Database.open(database.path), head=HEAD).frames == loops.frames


def city_drive(seed, turns, frames, estates=()):
    """Descriptors and poses of a drive through the synthetic city."""
    head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
    made = list(SyntheticCity(seed, estates).traverse(frames, size=(60, 80), turns=turns))
    labels = torch.from_numpy(np.stack([frame.labels for frame in made]))
    descriptors = torch.cat([head(part) for part in labels.split(16)])
    return descriptors, np.array([frame.pose for frame in made])


def city_loops(descriptors):
    """Row of the candidate of each frame that closes a loop, -1 for the others."""
    found = accepted(drive(detector(), list(descriptors)))
    return np.array([found.get(row, -1) for row in range(len(descriptors))])


def test_a_street_that_looks_alike_all_along_closes_no_loop():
    """The same houses block after block, 380 m long."""
    descriptors, _ = city_drive(1, [STRAIGHT] * 5, 130, estates=(0,))
    assert (city_loops(descriptors) == -1).all()


def test_the_second_time_round_a_block_closes_loops_and_only_right_ones():
    descriptors, poses = city_drive(1, [LEFT] * 8, 220)
    score = score_loops(city_loops(descriptors), poses, LoopConfig.exclude, metres=10.0)
    assert score.revisits > 80
    assert score.precision == 1
    assert score.recall > 0.2
