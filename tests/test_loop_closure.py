"""The loop detector: each check by hand, all of them against a plain formulation, checkpoints."""

import dataclasses
import itertools
import math
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import flip_byte, street
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_streams import PLACES, configs, noisy_stream, streams

from ssrvlad_torch import SSRVLAD, Database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.datasets.synthetic_city import LEFT, STRAIGHT, SyntheticCity
from ssrvlad_torch.evaluation.loops import score_loops
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.detector import STATE_FILE, LoopDetector
from ssrvlad_torch.loops.result import Reason
from ssrvlad_torch.recognition.matching import temporal_sum

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
PLAIN = LoopConfig(
    exclude=5, temporal=0, threshold=0.8, relative=0, ratio=1.0, neighbourhood=2, confirmations=1
)
"""The last five frames are no candidates, and a cosine of 0.8 is enough."""


def like(place, cosine, other):
    """A descriptor that has a cosine with a place, and all the rest of its length with another."""
    return np.float32(cosine) * PLACES[place] + math.sqrt(1 - cosine**2) * PLACES[other]


def detector(config=PLAIN, head=HEAD, **changes):
    gates = {name: changes.pop(name) for name in ("pose_gate", "geometry") if name in changes}
    return LoopDetector(dataclasses.replace(config, **changes), head, **gates)


def drive(loops, views, sequence="drive"):
    """Shows views, numbers of places or descriptors, to a detector."""
    return [
        loops.update(PLACES[view] if isinstance(view, int) else view, f"{sequence}/{number}")
        for number, view in enumerate(views, len(loops))
    ]


def reasons(results):
    return [result.reason.value for result in results]


def test_the_first_frames_have_nothing_to_compare_with():
    results = drive(detector(), [*range(7)])
    assert reasons(results) == ["no_candidate", *["too_recent"] * 5, "below_threshold"]
    assert results[5]._replace(frame="") == ("", Reason.TOO_RECENT, None, None, None)
    assert results[6][2:] == ("drive/0", 0.0, 0.0)


def test_a_place_seen_again_closes_a_loop():
    result = drive(detector(), [*range(10), like(3, 0.9, 99)])[-1]
    assert (result.frame, result.reason, result.candidate) == ("drive/10", "accepted", "drive/3")
    assert result.accepted
    assert result.score == result.strength == pytest.approx(0.9)


def test_a_score_equal_to_the_threshold_is_enough():
    threshold = float(np.float32(0.8))
    assert drive(detector(threshold=threshold), [*range(10), like(3, 0.8, 99)])[-1].accepted
    assert not drive(detector(threshold=0.8001), [*range(10), like(3, 0.8, 99)])[-1].accepted


def test_the_last_frames_are_no_candidates():
    """The fifth frame before is one too few, the sixth is old enough."""
    assert drive(detector(), [*range(10), 5])[-1].reason == "below_threshold"
    assert drive(detector(), [*range(10), 4])[-1].candidate == "drive/4"


def test_frames_are_excluded_by_seconds_too():
    def last(seconds, exclude=0):
        loops = detector(exclude=exclude, exclude_seconds=seconds, neighbourhood=1)
        for number, stamp in enumerate([0.0, 0.5, 0.5, 4.0, 9.0, 20.0]):
            loops.update(PLACES[number], f"drive/{number}", stamp)
        return loops.update(PLACES[3], "drive/6", 21.0)

    assert last(17.0)[1:3] == ("accepted", "drive/3")
    assert last(17.5).reason == "below_threshold"
    assert last(17.0, exclude=3).reason == "below_threshold"
    assert last(30.0).reason == "too_recent"


def test_the_map_is_late_by_the_temporal_reach():
    """With nothing excluded the frame before is a candidate, but for those that are not there."""
    views = [0, 1, 2, 2]
    assert drive(detector(exclude=0, neighbourhood=0), views)[-1].score == 1
    assert drive(detector(exclude=0, temporal=1), views)[-1][2:4] == (
        "drive/1",
        pytest.approx(3**-0.5),
    )
    assert drive(detector(exclude=0, temporal=2), views)[-1][2:4] == (
        "drive/0",
        pytest.approx(3**-0.5),
    )


def test_standing_still_closes_no_loop():
    """Many more frames of one place than are excluded; then away, and back."""
    loops = detector()
    results = drive(loops, [0, 1, *[2] * 30])
    assert set(reasons(results[8:])) == {"too_recent"}
    assert results[-1].candidate == "drive/2"
    assert reasons(drive(loops, [*range(10, 20), 2]))[-1] == "accepted"


def test_a_place_is_left_only_after_some_frames():
    """With a neighbourhood of two, two bad frames are not yet going away."""
    assert reasons(drive(detector(), [*[2] * 8, 30, 31, *[2] * 8]))[-1] == "too_recent"
    assert reasons(drive(detector(), [*[2] * 8, 30, 31, 32, 33, 34, 35, 2]))[-1] == "accepted"


def test_an_empty_frame_matches_nothing_and_is_matched_by_nothing():
    zero = np.zeros(480, np.float32)
    results = drive(detector(), [zero, zero, *range(4), zero, 50, 51])
    assert reasons(results[:3]) == ["empty_frame", "empty_frame", "too_recent"]
    assert results[6]._replace(frame="") == ("", Reason.EMPTY_FRAME, None, None, None)
    assert results[7][1:3] == ("no_candidate", None)
    assert results[8][1:3] == ("below_threshold", "drive/2")
    assert drive(detector(), [zero] * 6 + [1])[-1].reason == "no_candidate"


def test_another_place_that_is_nearly_as_much_alike_makes_it_ambiguous():
    """Cosines 0.72 and 0.65: the distances are the roots of 0.56 and 0.7, and 0.8944 times each
    other."""
    query = 0.72 * PLACES[3] + 0.65 * PLACES[7] + math.sqrt(1 - 0.72**2 - 0.65**2) * PLACES[99]
    views, ratio = [*range(20), query], 0.8944
    settings = {"threshold": 0.5}
    assert drive(detector(ratio=ratio - 0.01, **settings), views)[-1].reason == "ambiguous"
    assert drive(detector(ratio=ratio + 0.01, **settings), views)[-1].reason == "accepted"
    assert drive(detector(ratio=ratio - 0.01, **settings), views)[-1].candidate == "drive/3"


def test_frames_beside_the_candidate_show_its_place():
    """A neighbour within two frames that scores as well is no rival, one three frames away is."""
    views = [*range(20)]
    for rival, reason in ((5, "accepted"), (1, "accepted"), (6, "ambiguous"), (0, "ambiguous")):
        views[rival] = like(3, 0.999, 98)
        result = drive(detector(ratio=0.9), [*views, like(3, 0.97, 99)])[-1]
        assert (result.reason, result.candidate) == (reason, "drive/3")
        views[rival] = rival


def test_a_frame_too_recent_may_be_the_rival():
    """One of the last frames is elsewhere and looks the same: looks say nothing here."""
    views = [*range(10), like(3, 0.999, 98), 11, 12, 13, like(3, 0.97, 99)]
    results = drive(detector(ratio=0.9, exclude=8), views)
    assert results[10].candidate != "drive/3"
    assert results[-1][1:3] == ("ambiguous", "drive/3")
    assert drive(detector(exclude=8), views)[-1].reason == "accepted"


def test_an_earlier_visit_to_the_same_place_is_no_rival():
    """The second visit closed a loop with the first, so the third sees one place, not two."""
    loops = detector(ratio=0.9)
    results = drive(loops, [*range(10), 3, *range(10, 20), 3])
    assert [r.candidate for r in results if r.accepted] == ["drive/3", "drive/3"]
    unlinked = [*range(10), like(3, 0.98, 98), *range(10, 20), like(3, 0.995, 98)]
    results = drive(detector(ratio=0.9, threshold=0.99), unlinked)
    assert reasons(results)[10] == "below_threshold"
    assert results[-1][1:3] == ("ambiguous", "drive/3")


def test_frames_that_waited_for_their_confirmation_are_linked_with_it():
    """The first of three frames in a row is inconsistent; when the third is accepted it is known
    to show its candidate's place, and so is no rival on the next visit."""
    loops = detector(ratio=0.9, confirmations=3, window=1, threshold=0.2)
    there = [3, 4, 5, 6, 7, 8]
    drive(loops, range(20))
    second = drive(loops, there)
    assert reasons(second) == ["inconsistent"] * 2 + ["accepted"] * 4
    drive(loops, range(20, 30))
    assert reasons(drive(loops, there)) == ["inconsistent"] * 2 + ["accepted"] * 4


@pytest.mark.parametrize("step", [1, -1, 2])
def test_candidates_must_stay_together(step):
    """Forwards, backwards, and twice as fast as before."""
    loops = detector(confirmations=3, window=2, threshold=0.2)
    drive(loops, range(30))
    back = [10 + step * n for n in range(5)]
    assert reasons(drive(loops, back)) == ["inconsistent"] * 2 + ["accepted"] * 3


def test_a_jump_asks_for_confirmation_anew():
    loops = detector(confirmations=2, window=2, threshold=0.4)
    drive(loops, range(30))
    assert reasons(drive(loops, [10, 11, 20, 21, 24, 25])) == ["inconsistent", "accepted"] * 3


def test_the_frames_that_confirm_each_other_share_their_strength():
    """Cosines 1, 0.5, 1: their mean is enough, that of the first two is not. The frame before them
    has cosine 0 with all places."""
    loops = detector(confirmations=3, window=2, threshold=0.8)
    drive(loops, range(30))
    results = drive(loops, [10, like(11, 0.5, 99), 12])
    assert reasons(results) == ["below_threshold", "below_threshold", "accepted"]
    assert [r.strength for r in results] == pytest.approx([1 / 3, 1.5 / 3, 2.5 / 3])
    assert [r.score for r in results] == pytest.approx([1, 0.5, 1])


def test_an_empty_frame_or_another_sequence_breaks_the_confirmation():
    loops = detector(confirmations=2, threshold=0.4)
    drive(loops, range(30))
    zero = np.zeros(480, np.float32)
    assert reasons(drive(loops, [10, zero, 11, 12])) == [
        "inconsistent",
        "empty_frame",
        "inconsistent",
        "accepted",
    ]
    assert reasons(drive(loops, [13, 14], "another")) == ["inconsistent", "accepted"]


def test_a_relative_threshold_counts_standard_deviations():
    """Nine candidates at one distance and one nearer, whatever they are: the mean lies a tenth of
    the way to the near one and the deviation is three tenths, so it stands out by 3."""
    for near in (4, like(4, 0.7, 99)):
        assert drive(detector(relative=1), [*range(15), near])[-1].strength == pytest.approx(3)
    views = [*range(15), 4]
    result = drive(detector(relative=1, threshold=2.999), views)[-1]
    assert (result.reason, result.candidate) == ("accepted", "drive/4")
    assert (result.score, result.strength) == (1, pytest.approx(3))
    assert drive(detector(relative=1, threshold=3.001), views)[-1].reason == "below_threshold"


def test_a_relative_threshold_may_look_at_the_frames_before():
    """Of ten candidates one is near, then of eleven; each frame weighs the same."""
    mean, square = (1 / 10 + 1 / 11) / 2, (1 / 10 + 1 / 11) / 2
    strength = (1 - mean) / math.sqrt(square - mean**2)
    assert drive(detector(relative=2), [*range(15), 4, 5])[-1].strength == pytest.approx(strength)
    assert drive(detector(relative=1), [*range(15), 4, 5])[-1].strength == pytest.approx(10**0.5)


def test_standing_out_is_measured_in_logarithms_of_distances():
    """Cosines 0 and 0.5, the same number of times, and 0.75: half the squared distances are 1, 1/2
    and 1/4, so their logarithms are evenly spaced."""
    query = 0.75 * PLACES[0] + 0.5 * PLACES[1]
    query += math.sqrt(1 - query @ query) * PLACES[99]
    result = drive(detector(relative=1, exclude=3), [0, 1, 2, 50, 51, 52, query])[-1]
    assert result.candidate == "drive/0"
    assert result.strength == pytest.approx(1 / math.sqrt(2 / 3), rel=1e-5)


def test_a_relative_threshold_finds_nothing_where_all_is_alike():
    results = drive(detector(relative=1, threshold=0.5), [3] * 40)
    assert set(reasons(results[6:])) == {"below_threshold"}


def test_the_pose_gate_chooses_among_the_candidates():
    def near(here, there):
        assert here.shape == (3,)
        assert there.shape[1:] == (3,)
        return np.abs(there[:, 0] - here[0]) <= 4

    def last(x):
        loops = detector(pose_gate=near, ratio=0.9)
        views = [*range(20)]
        views[12] = 3
        for number, view in enumerate(views):
            loops.update(PLACES[view], f"drive/{number}", pose=(number, 0.0))
        return loops.update(PLACES[3], "drive/20", pose=(x, 0.0, 1.0))

    assert last(2.0)[1:3] == ("accepted", "drive/3")
    assert last(10.0)[1:3] == ("accepted", "drive/12")
    assert last(7.5).reason == "below_threshold"
    assert last(-100.0)[1:] == ("implausible", None, None, None)


def test_the_pose_gate_is_held_to_its_word():
    loops = detector(pose_gate=lambda here, there: np.hypot(*(there - here)[:, :2].T))
    with pytest.raises(ValueError, match="'drive/0' has no pose, which the pose gate wants"):
        loops.update(PLACES[0], "drive/0")
    for number in range(6):
        loops.update(PLACES[number], f"drive/{number}", pose=(0, 0))
    with pytest.raises(ValueError, match=r"gave \(6,\) float64 for 6 poses; wanted a bool"):
        loops.update(PLACES[0], "drive/6", pose=(0, 0))
    assert len(loops) == 6


def test_the_pose_gate_cannot_change_the_poses():
    def spoil(here, there):
        there[:] = 0

    loops = detector(pose_gate=spoil)
    for number in range(6):
        loops.update(PLACES[number], f"drive/{number}", pose=(number, 7))
    with pytest.raises(ValueError, match="read-only"):
        loops.update(PLACES[0], "drive/6", pose=(0, 0))
    assert loops.poses[:, 1].tolist() == [7] * 6


def test_the_geometric_check_has_the_last_word():
    asked = []

    def check(here, there):
        asked.append((here, there))
        return there.frame != "drive/3"

    loops = detector(geometry=check)
    for number in range(10):
        loops.update(PLACES[number], f"drive/{number}", stamp=number, pose=(number, 1))
    assert not asked
    assert loops.update(PLACES[3], "drive/10", 10.0).reason == "disproved"
    assert loops.update(PLACES[4], "drive/11", 11.0).reason == "accepted"
    here, there = asked[0]
    assert (here.frame, here.stamp, here.keypoints) == ("drive/10", 10.0, None)
    assert (there.frame, there.stamp, there.pose[:2].tolist()) == ("drive/3", 3.0, [3, 1])


def test_the_geometric_check_gets_key_points_of_label_maps():
    asked = []
    loops = detector(geometry=lambda here, there: not asked.append((here, there)))
    maps = [street(seed) for seed in (*range(8), 2)]
    for number, labels in enumerate(maps):
        result = loops.update(labels, f"drive/{number}")
    assert (result.reason, result.candidate) == ("accepted", "drive/2")
    ((here, there),) = asked
    view = HEAD.explain(torch.from_numpy(maps[2])[None])
    wanted = view.keypoints[0].nonzero().numpy()
    assert len(wanted)
    for sighting in (here, there):
        np.testing.assert_array_equal(sighting.keypoints, wanted)


def test_label_maps_scores_and_descriptors_are_the_same_frame():
    maps = [street(seed) for seed in (*range(8), 2)]
    scores = [
        torch.nn.functional.one_hot(torch.from_numpy(m).long(), 12).movedim(-1, 0).float()
        for m in maps
    ]
    given = [
        maps,
        [torch.from_numpy(m) for m in maps],
        scores,
        [HEAD(torch.from_numpy(m)[None])[0] for m in maps],
    ]
    results = []
    for views in given:
        loops = detector()
        results.append([loops.update(view, f"drive/{n}") for n, view in enumerate(views)])
    assert results[0][-1].accepted
    assert results[1:] == results[:1] * 3


def plain_detector(vectors, sequences, config):
    """The rules once more, frame by frame, in lists and loops; for an absolute or a relative
    threshold of one frame."""
    found, place = [], list(range(len(vectors)))
    candidates, strengths = [], []
    for n, vector in enumerate(vectors):
        candidates.append(None)
        strengths.append(None)
        if not vector.any():
            found.append(("empty_frame", None))
            continue
        summed = temporal_sum(vectors[:n], sequences[:n], config.temporal).numpy() if n else []
        mapped = [
            m for m in range(n) if m + config.temporal < n or sequences[m] != sequences[n - 1]
        ]
        old = [m for m in mapped if m < n - config.exclude]
        cosines = np.dot(summed[: len(mapped)], vector / np.linalg.norm(vector)) if mapped else []
        scores = {m: float(cosines[m]) for m in mapped if vectors[m].any()}
        compared = [scores[m] for m in old if m in scores]
        if not compared:
            found.append(("no_candidate" if n == 0 or old else "too_recent", None))
            continue
        best = max((m for m in old if m in scores), key=lambda m: (scores[m], -m))
        candidates[n] = best
        strengths[n], cutoff = scores[best], config.threshold
        if config.relative:
            logs = [math.log(max(1 - score, 1e-6)) for score in compared]
            mean, spread = np.mean(logs), max(np.std(logs), 1e-6)
            strengths[n] = (mean - math.log(max(1 - scores[best], 1e-6))) / spread
            cutoff = 1 - math.exp(mean - config.threshold * spread)
        last = [s for s in strengths[max(0, n + 1 - config.confirmations) :] if s is not None]
        reason = "below_threshold"
        if np.mean(last) >= config.threshold:
            least = min(cutoff, scores[best])
            reason = plain_reason(n, best, scores, least, candidates, place, sequences, config)
        found.append((reason, best))
        if found[-1][0] == "accepted":
            for m in range(n + 1 - config.confirmations, n + 1):
                place[m] = place[candidates[m]]
    return found


def plain_reason(n, best, scores, cutoff, candidates, place, sequences, config):
    present = n
    for m in sorted((m for m in scores if scores[m] >= cutoff), reverse=True):
        if present - m - 1 <= config.neighbourhood + config.temporal:
            present = m
    if best >= present:
        return "too_recent"
    apart = [abs(place[m] - place[best]) for m in range(n)]
    rivals = [
        scores[m]
        for m in scores
        if m < present - config.neighbourhood
        and all(abs(m - s) + apart[s] > config.neighbourhood for s in range(n))
    ]
    if config.ratio < 1 and rivals and 1 - scores[best] > config.ratio**2 * (1 - max(rivals)):
        return "ambiguous"
    last = candidates[max(0, n + 1 - config.confirmations) : n + 1]
    together = len(last) == config.confirmations and None not in last
    together = together and len({*sequences[n + 1 - len(last) : n + 1]}) == 1
    if not together or any(abs(a - b) > config.window for a, b in itertools.pairwise(last)):
        return "inconsistent"
    return "accepted"


@settings(max_examples=200, deadline=None)
@given(streams, configs)
def test_the_detector_follows_the_rules(stream, config):
    vectors, sequences = stream
    loops = LoopDetector(config, HEAD)
    got = []
    for number, (vector, sequence) in enumerate(zip(vectors, sequences, strict=True)):
        result = loops.update(vector, f"{sequence}/{number}")
        row = result.candidate and int(result.candidate.rpartition("/")[2])
        got.append((result.reason.value, row))
    assert got == plain_detector(vectors, sequences, config)


BAD_FRAMES = {
    "there before": lambda loops: loops.update(PLACES[0], "drive/3"),
    "no sequence": lambda loops: loops.update(PLACES[0], "000007"),
    "no name": lambda loops: loops.update(PLACES[0], "drive/"),
    "too short": lambda loops: loops.update(PLACES[0, :9], "drive/a"),
    "not finite": lambda loops: loops.update(np.full(480, np.nan, np.float32), "drive/a"),
    "unknown id": lambda loops: loops.update(np.full((9, 9), 77), "drive/a"),
    "a batch": lambda loops: loops.update(np.zeros((2, 9, 9), int), "drive/a"),
    "back in time": lambda loops: loops.update(PLACES[0], "drive/a", stamp=3.9),
    "stamp not finite": lambda loops: loops.update(PLACES[0], "drive/a", stamp=math.inf),
    "no stamp": lambda loops: loops.update(PLACES[0], "drive/a"),
    "pose of one": lambda loops: loops.update(PLACES[0], "drive/a", 5.0, pose=[1.0]),
}
MESSAGES = {
    "there before": "frame 'drive/3' was there before",
    "no sequence": "id must be <sequence>/<name>, got '000007'",
    "no name": "id must be <sequence>/<name>, got 'drive/'",
    "too short": r"'drive/a' has a descriptor of shape \(9,\); wanted \(480,\)",
    "not finite": "'drive/a' has a descriptor with values that are not finite",
    "unknown id": "77",
    "a batch": "class scores must be floating point",
    "back in time": "'drive/a' has stamp 3.9; wanted one from 4.0 on",
    "stamp not finite": "'drive/a' has stamp inf",
    "no stamp": "'drive/a' has no stamp, which exclude_seconds wants",
    "pose of one": "'drive/a' has a pose of 1 numbers; wanted x, y, heading",
}


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_a_frame_that_is_refused_leaves_no_trace(name):
    loops, spared = (detector(exclude=1, exclude_seconds=1.0, temporal=1) for _ in range(2))
    for each in (loops, spared):
        for number in range(5):
            each.update(PLACES[number], f"drive/{number}", float(number))
    with pytest.raises(ValueError, match=MESSAGES[name]) as caught:
        BAD_FRAMES[name](loops)
    assert "\n" not in str(caught.value)
    assert (len(loops), "drive/a" in loops) == (5, False)
    after = [each.update(like(1, 0.9, 0), "drive/z", 6.0) for each in (loops, spared)]
    assert after[0] == after[1]


def test_a_gate_that_fails_leaves_no_trace():
    def fail(here, there):
        raise RuntimeError("broken")

    loops = detector(geometry=fail)
    drive(loops, range(8))
    with pytest.raises(RuntimeError, match="broken"):
        loops.update(PLACES[1], "drive/8")
    assert (len(loops), "drive/8" in loops) == (8, False)


def test_the_map_lags_and_is_complete_once_its_sequence_ends():
    loops = detector(temporal=2)
    drive(loops, range(10))
    vectors = torch.from_numpy(PLACES[:10])
    wanted = temporal_sum(vectors, ["drive"] * 10, 2).numpy()
    assert loops.snapshot.frames == [f"drive/{n}" for n in range(8)]
    np.testing.assert_array_equal(loops.snapshot.descriptors, wanted[:8])
    loops.end_sequence()
    np.testing.assert_array_equal(loops.snapshot.descriptors, wanted)
    assert loops.frames == loops.snapshot.frames == [f"drive/{n}" for n in range(10)]


@pytest.mark.parametrize("reach", [1, 3])
def test_the_map_equals_what_the_database_gives_offline(tmp_path, reach):
    """Bit by bit, over two drives, of which one is shorter than the sum reaches."""
    loops = detector(temporal=reach)
    vectors = noisy_stream(reach, 60, 12, [])[0]
    drive(loops, vectors[:57], "a")
    drive(loops, vectors[57:], "b")
    loops.end_sequence()
    loops.save(Database.create(tmp_path / "db", HEAD.config))
    offline = Database.open(tmp_path / "db").load()
    summed = temporal_sum(offline.descriptors, offline.sequences, reach)
    assert list(offline.frames) == loops.snapshot.frames
    np.testing.assert_array_equal(loops.snapshot.descriptors, summed.numpy())


def test_poses_are_kept():
    loops = detector()
    loops.update(PLACES[0], "drive/0", pose=(1, 2))
    loops.update(PLACES[1], "drive/1", pose=(3, 4, 5))
    loops.update(PLACES[2], "drive/2")
    np.testing.assert_array_equal(loops.poses, [[1, 2, np.nan], [3, 4, 5], [np.nan] * 3])


def show(loops, stream, begin, end):
    """Rows of a stream of `noisy_stream`, with poses and stamps."""
    vectors, sequences = stream
    return [
        loops.update(vectors[n], f"{sequences[n]}/{n}", float(n // 2), (n, -n, 0.5))
        for n in range(begin, end)
    ]


@settings(max_examples=40, deadline=None)
@given(streams, configs, st.lists(st.floats(0, 1), max_size=3), st.sampled_from([0.0, 2.0]))
def test_interrupted_it_goes_on_as_if_never_stopped(
    tmp_path_factory, stream, config, cuts, seconds
):
    """Stopped, loaded and gone on at any frames, with frames lost after the checkpoint."""
    config = dataclasses.replace(config, exclude_seconds=seconds, relative=3 * config.relative)
    length = len(stream[0])
    whole = show(LoopDetector(config, HEAD), stream, 0, length)
    database = Database.create(tmp_path_factory.mktemp("loops") / "db", HEAD.config)
    loops, begin, results = LoopDetector(config, HEAD), 0, []
    for cut in sorted(round(cut * length) for cut in cuts):
        results += show(loops, stream, begin, cut)
        loops.save(database)
        show(loops, stream, cut, min(cut + 3, length))  # lost in a crash
        loops, begin = LoopDetector.load(Database.open(database.path), config, HEAD), cut
        database = Database.open(database.path)
        assert loops.frames == [f"{stream[1][n]}/{n}" for n in range(cut)]
    assert results + show(loops, stream, begin, length) == whole


@pytest.mark.parametrize("when", ["state", "database"])
def test_a_crash_while_saving_leaves_a_checkpoint(tmp_path, monkeypatch, when):
    """The disk is full as either file is written: the last checkpoint stands, and saving again
    once there is room loses nothing."""
    stream = noisy_stream(3, 60, 12, [40])
    config = dataclasses.replace(PLAIN, temporal=1, threshold=0.6)
    database = Database.create(tmp_path / "db", HEAD.config)
    whole = show(LoopDetector(config, HEAD), stream, 0, 60)
    loops = LoopDetector(config, HEAD)
    show(loops, stream, 0, 30)
    loops.save(database)
    results = show(loops, stream, 30, 45)

    def full(*arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        if when == "state":
            patch.setattr("ssrvlad_torch.loops.detector.write_state", full)
        else:
            patch.setattr(Database, "append", full)
        with pytest.raises(OSError, match="No space"):
            loops.save(database)
    crashed = LoopDetector.load(Database.open(database.path), config, HEAD)
    assert len(crashed) == 30
    assert show(crashed, stream, 30, 60) == whole[30:]
    loops.save(database)
    assert results == whole[30:45]
    assert len(LoopDetector.load(Database.open(database.path), config, HEAD)) == 45


def test_a_checkpoint_is_an_ordinary_database(tmp_path):
    database = Database.create(tmp_path / "db", HEAD.config)
    loops = detector(temporal=2)
    maps = [street(seed) for seed in range(6)]
    for number, labels in enumerate(maps):
        loops.update(labels, f"drive/{number}", pose=(number, 0, 1))
    loops.save(database)
    loops.save(database)
    stored = Database.open(database.path).load()
    raw = HEAD(torch.from_numpy(np.stack(maps)))
    assert torch.equal(stored.descriptors, raw)
    assert stored.poses[:, 0].tolist() == [*range(6)]
    for number, labels in enumerate(maps):
        known = database.known()[f"drive/{number}"]
        assert (known.digest, known.height, known.width) == (digest(labels), 24, 32)


def test_any_database_is_a_map_of_places_seen_long_ago(tmp_path):
    """Frames keep the order in which they were added, which their names need not follow."""
    database = Database.create(tmp_path / "db", HEAD.config)
    names = ["9", "2", "11", "0"]
    for part in (names[:3], names[3:]):
        records = [FrameRecord("map", n, x=float(n), y=0.0) for n in part]
        database.append(records, torch.from_numpy(PLACES[[int(n) for n in part]]))
    loops = LoopDetector.load(
        database, dataclasses.replace(PLAIN, exclude=0, neighbourhood=0), HEAD
    )
    assert loops.frames == ["map/9", "map/2", "map/11", "map/0"]
    assert loops.poses[:, 0].tolist() == [9, 2, 11, 0]
    result = loops.update(PLACES[2], "drive/0")
    assert (result.reason, result.candidate) == ("accepted", "map/2")
    assert LoopDetector.load(database).head.config == database.config


def test_frames_of_a_map_are_old_by_any_clock(tmp_path):
    database = Database.create(tmp_path / "db", HEAD.config)
    records = [FrameRecord("map", str(n)) for n in range(3)]
    database.append(records, torch.from_numpy(PLACES[:3]))
    config = dataclasses.replace(PLAIN, exclude=0, exclude_seconds=10.0, neighbourhood=0)
    loops = LoopDetector.load(database, config, HEAD)
    loops.update(PLACES[3], "drive/0", -5.0)
    assert loops.update(PLACES[1], "drive/1", -4.0).candidate == "map/1"


def test_a_foreign_database_is_refused(tmp_path):
    loops = detector()
    drive(loops, range(3))
    other = Database.create(tmp_path / "other", SSRVLAD.from_preset("paper").config)
    with pytest.raises(ValueError, match="has fingerprint"):
        loops.save(other)
    with pytest.raises(ValueError, match="has fingerprint"):
        LoopDetector.load(other, head=HEAD)
    filled = Database.create(tmp_path / "filled", HEAD.config)
    filled.append([FrameRecord("map", "0")], torch.from_numpy(PLACES[:1]))
    with pytest.raises(ValueError, match="holds 1 frames; 0 of this stream were saved"):
        loops.save(filled)
    assert not (Path(filled.path, STATE_FILE)).exists()


@pytest.mark.parametrize("damage", ["byte", "cut", "text", "columns", "empty"])
def test_a_damaged_state_is_refused(tmp_path, damage):
    database = Database.create(tmp_path / "db", HEAD.config)
    loops = detector()
    drive(loops, range(50))
    loops.save(database)
    state = Path(database.path, STATE_FILE)
    if damage == "byte":
        flip_byte(state, state.read_bytes().index(loops._log.state()["strength"].tobytes()) + 9)
    elif damage == "columns":
        with np.load(state) as file:
            columns = dict(file)
        np.savez(state, **{**columns, "candidate": columns["candidate"][:-1]})
    else:
        state.write_bytes({"cut": state.read_bytes()[:-40], "text": b"loops", "empty": b""}[damage])
    with pytest.raises(ValueError, match=rf"{STATE_FILE} is damaged: ") as caught:
        LoopDetector.load(database, PLAIN, HEAD)
    assert "\n" not in str(caught.value)


def test_a_state_of_other_frames_is_refused(tmp_path):
    """The database was made anew, of the same number of frames."""
    first, second = (Database.create(tmp_path / name, HEAD.config) for name in ("first", "second"))
    for database, sequence in ((first, "monday"), (second, "tuesday")):
        loops = detector()
        drive(loops, range(9), sequence)
        loops.save(database)
    (Path(first.path, STATE_FILE)).replace(Path(second.path, STATE_FILE))
    with pytest.raises(
        ValueError, match=r"loops\.npz does not fit: frame 'tuesday/0' has the entry"
    ):
        LoopDetector.load(second, PLAIN, HEAD)
    (Path(second.path, STATE_FILE)).unlink()
    assert len(LoopDetector.load(second, PLAIN, HEAD)) == 9


def test_one_updates_while_others_search_and_save(tmp_path):
    stream = noisy_stream(8, 900, 40, [300, 500])
    config = dataclasses.replace(PLAIN, temporal=2, threshold=0.6)
    whole = show(LoopDetector(config, HEAD), stream, 0, 900)
    loops, done, errors = LoopDetector(config, HEAD), threading.Event(), []
    database = Database.create(tmp_path / "db", HEAD.config)
    sizes = []

    def search():
        snapshot = loops.snapshot
        if snapshot.rows:
            row = snapshot.rows // 2
            query = snapshot.descriptors[row]
            (frame, score), *_ = snapshot.search(query, 1) or [(snapshot.frames[0], 0)]
            assert frame in snapshot.frames
            assert score == pytest.approx(float(query.any()), abs=1e-6)

    def save():
        loops.save(database)
        sizes.append(len(database))

    def repeat(work):
        try:
            while not done.is_set():
                work()
        except BaseException as error:
            errors.append(error)
            raise

    threads = [threading.Thread(target=repeat, args=(work,)) for work in (search, search, save)]
    for thread in threads:
        thread.start()
    results = show(loops, stream, 0, 900)
    done.set()
    for thread in threads:
        thread.join()
    assert not errors
    assert results == whole
    loops.save(database)
    assert sorted(sizes) == sizes
    stored = LoopDetector.load(Database.open(database.path), config, HEAD)
    assert stored.frames == loops.frames
    np.testing.assert_array_equal(stored.snapshot.descriptors, loops.snapshot.descriptors)


def city_drive(seed, turns, frames, estates=()):
    """Descriptors and poses of a drive through the synthetic city."""
    head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
    drive = list(SyntheticCity(seed, estates).traverse(frames, size=(120, 160), turns=turns))
    labels = torch.from_numpy(np.stack([frame.labels for frame in drive]))
    descriptors = torch.cat([head(part) for part in labels.split(16)])
    return descriptors, np.array([frame.pose for frame in drive])


def city_loops(descriptors, config):
    """Row of the candidate of each frame that closes a loop, -1 for the others."""
    results = drive(LoopDetector(config, HEAD), list(descriptors))
    return np.array([int(r.candidate[6:]) if r.accepted else -1 for r in results])


def test_a_street_that_looks_alike_all_along_closes_no_loop():
    """The same houses block after block, 380 m long. A low threshold without the other checks
    falls for them."""
    descriptors, _ = city_drive(1, [STRAIGHT] * 5, 130, estates=(0,))
    fooled = LoopConfig(threshold=3.0, ratio=1.0, confirmations=1)
    assert (city_loops(descriptors, fooled) >= 0).sum() > 5
    assert (city_loops(descriptors, LoopConfig()) == -1).all()


def test_the_second_time_round_a_block_closes_loops_and_only_right_ones():
    """The map is small, so that the threshold must be low; see `LoopConfig.relative`."""
    descriptors, poses = city_drive(1, [LEFT] * 8, 220)
    loops = city_loops(descriptors, LoopConfig(threshold=3.5))
    score = score_loops(loops, poses, LoopConfig.exclude, metres=10.0)
    assert score.revisits > 80
    assert score.precision == 1
    assert score.recall > 0.2
    near = score_loops(loops, poses, LoopConfig.exclude, metres=5.0)
    assert near.right > 0.9 * near.accepted
