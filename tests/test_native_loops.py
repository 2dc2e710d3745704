"""The live stream of the native core: held to the oracle on random streams, and its refusals."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_streams import LIGHT, PLACES, hog_of, noisy_stream, signs_of, unit

from ssrvlad_torch.loops import reference
from ssrvlad_torch.native import loops
from ssrvlad_torch.native.loops import SCAN_ABOVE, Channel, Loops

pytestmark = pytest.mark.usefixtures("core")

CHANNELS = [
    Channel("ssr-vlad", (480,)),
    Channel("features", (16, 2, 8), "uint8", 6.0),
    Channel("hog", (480,), "float32", 2.0),
]


def both(frames, starts, stamps=None, known=0, **settings):
    """What the core and the oracle find, of ``(N, ...)`` descriptors by channel, of which the first
    are known: both streams, and both results of each frame."""
    channels = [each for each in CHANNELS if each.name in frames]
    streams = [form(channels, **settings) for form in (Loops, reference.Loops)]
    stamps = np.full(len(starts), math.nan) if stamps is None else stamps
    for stream in streams:
        centres = {each.name: frames[each.name][:known] for each in channels}
        centres["ssr-vlad"] = centres["ssr-vlad"][:, frames["ssr-vlad"].shape[1] // 2]
        stream.extend(centres, stamps[:known], starts[:known])
    found = []
    for row in range(known, len(starts)):
        one = {name: each[row] for name, each in frames.items()}
        found.append([stream.update(one, stamps[row], starts[row]) for stream in streams])
    return streams, found


def assert_same(streams, found, threshold):
    """Scores and probabilities are equal but for rounding, and so are decisions, but for those that
    rounding decides: at the threshold, and between two rows or reasons that are as probable or of
    no probability."""
    ours, theirs = streams
    assert ours.weights == pytest.approx(theirs.weights, abs=1e-5)
    for one, other in found:
        assert (one.candidate is None) == (other.candidate is None)
        if one.candidate is None:
            assert one == other
            continue
        if abs(other.probability - threshold) > 1e-4:
            assert (one.reason == "accepted") == (other.reason == "accepted")
        if one.candidate == other.candidate:
            assert one.probability == pytest.approx(other.probability, abs=2e-5)
            assert one.score == pytest.approx(other.score, abs=1e-5)
            assert one.first == other.first
            assert one.near == pytest.approx(other.near, abs=2e-5)
            for place, wanted in zip(one.places, other.places, strict=False):
                assert place[1] == pytest.approx(wanted[1], abs=2e-5)
    different = [one for one, other in found if one[:2] != other[:2]]
    probable = [one for one in different if one.probability > 1e-3]
    assert len(probable) <= max(1, 0.02 * len(found))


@st.composite
def streams(draw):
    """Channels of a walk with empty frames, its sequences and stamps with gaps, how many frames are
    known, and settings."""
    anchors, length = draw(st.sampled_from([1, 3, 5])), draw(st.integers(1, 160))
    seed, places = draw(st.integers(0, 2**31)), draw(st.integers(2, 80))
    changes = draw(st.lists(st.integers(0, 160), max_size=2))
    swept, names = noisy_stream(seed, length, places, changes, anchors)
    light = np.random.default_rng(seed).normal(0, 0.3, (3, 480)).astype(np.float32)
    drives = np.array([int(name.split()[1]) for name in names])
    described = swept.any(axis=2)
    swept[described] = unit((swept + draw(st.booleans()) * light[drives][:, None])[described])
    usual = swept[:, anchors // 2]
    frames = {"ssr-vlad": swept}
    if draw(st.booleans()):
        frames["features"] = np.array([signs_of(each) for each in usual])
    if draw(st.booleans()):
        frames["hog"] = np.array([hog_of(each) for each in usual])
    stamps = np.arange(length) / 3
    for row in draw(st.lists(st.integers(20, 160), max_size=2)):
        stamps[row:] += 3600
    starts = np.diff(drives, prepend=-1) > 0
    settings = {
        "exclude": draw(st.integers(0, 60)),
        "threshold": draw(st.sampled_from([0.3, 0.8])),
        "scan_above": draw(st.sampled_from([SCAN_ABOVE, 20, 40, 80])),
    }
    return frames, starts, stamps, draw(st.integers(0, length)), settings


@given(streams())
def test_the_core_finds_what_the_oracle_finds(stream):
    frames, starts, stamps, known, settings = stream
    assert_same(*both(frames, starts, stamps, known, **settings), settings["threshold"])


def test_a_return_in_another_light_is_that_of_the_oracle():
    """Without a gap, by all channels: the tracks of the stream tell it."""
    street = PLACES[:300] + PLACES[1:301]
    drawn = np.random.default_rng(0).normal(0, 0.3 / 22, (230, 480))
    light = 0.35 * LIGHT
    vectors = unit(np.concatenate((street[:150], street[40:120] + light)) + drawn)
    frames = {"ssr-vlad": vectors[:, None]}
    frames |= {"features": np.array([*map(signs_of, vectors)])}
    frames |= {"hog": np.array([*map(hog_of, vectors)])}
    streams, found = both(frames, np.arange(230) == 0)
    assert_same(streams, found, 0.8)
    assert sum(one.reason == "accepted" for one, _ in found[150:]) > 30


def test_an_empty_frame_is_no_place_whatever_other_channels_see():
    """The first 30 frames of a street have no label map; then the whole street comes again."""
    vectors = unit(PLACES[:120] + PLACES[1:121])[[*range(120), *range(120)]]
    frames = {"features": np.array([*map(signs_of, vectors)]), "ssr-vlad": vectors[:, None].copy()}
    frames["ssr-vlad"][:30] = 0
    streams, found = both(frames, np.arange(240) % 120 == 0)
    assert_same(streams, found, 0.8)
    for one, _ in found[120:]:
        assert one.candidate >= 30
    assert not any(one.reason == "accepted" for one, _ in found[120:150])
    assert sum(one.reason == "accepted" for one, _ in found[150:]) > 60


def test_a_frame_is_empty_where_the_first_channel_is_zero_signs_too():
    signs = np.random.default_rng(0).integers(0, 256, (40, 16, 2, 8), np.uint8)
    signs[[0, 7, 39]] = 0
    for form in (Loops, reference.Loops):
        stream = form([CHANNELS[1]], exclude=5)
        found = [stream.update({"features": each}) for each in signs]
        empty = [row for row, each in enumerate(found) if each.reason == "empty_frame"]
        assert empty == [0, 7, 39]
        assert all(each.candidate not in (0, 7) for each in found)


def test_a_long_stream_passes_the_ends_of_blocks():
    """More rows than stand together in memory, over a sequence that starts within them."""
    swept, names = noisy_stream(3, 1110, 110, [600], 3)
    starts = np.array([a != b for a, b in zip(names, ["", *names], strict=False)])
    frames = {"ssr-vlad": swept, "features": np.array([signs_of(each[1]) for each in swept])}
    streams, found = both(frames, starts, known=1100)
    assert_same(streams, found, 0.8)
    ours, _ = streams
    for first, last in ((0, 3), (1020, 1030), (1100, 1110)):
        rows = ours.descriptors("features", first, last)
        np.testing.assert_array_equal(rows, frames["features"][first:last])
        rows = ours.descriptors("ssr-vlad", first, last)
        np.testing.assert_array_equal(rows, swept[first:last, 1])


def test_a_large_memory_finds_what_the_oracle_finds():
    """Most rows have rough scores alone: of 350 and more, 50 are the last, and a few others. The
    street has 500 places, and then come its last 100 again, of which 60 are known."""
    rng = np.random.default_rng(0)
    rows = [*range(0, 500), *range(400, 500)]
    signs = rng.integers(0, 256, (500, 16, 2, 8), np.uint8)[rows]
    signs ^= np.bitwise_and.reduce(rng.integers(0, 256, (3, *signs.shape), np.uint8))
    vectors = unit(rng.normal(size=(500, 480)))[rows]
    vectors = unit(vectors + rng.normal(0, 0.02, vectors.shape))
    frames = {"ssr-vlad": vectors[:, None], "features": signs, "hog": vectors}
    streams, found = both(frames, np.arange(600) % 500 == 0, known=560, scan_above=350)
    assert_same(streams, found, 0.8)
    accepted = [
        (one.candidate, row) for row, (one, _) in enumerate(found, 460) if one[0] == "accepted"
    ]
    assert len(accepted) > 30
    assert all(candidate == row for candidate, row in accepted)


def test_programs_in_c_and_python_have_the_same_size_of_large_memories():
    header = (Path(loops.__file__).parent / "ssrvlad_loops.h").read_text()
    assert f"SSRVLAD_SCAN_ABOVE = {SCAN_ABOVE} " in header


def test_a_memory_is_large_alike_whether_frames_came_or_were_known():
    """It was small first, or was large at once; by signs alone, which weigh alike. What chance does
    is known of frames that came."""
    signs = np.random.default_rng(0).integers(0, 256, (240, 16, 2, 8), np.uint8)
    signs[200:] = signs[50:90] ^ (signs[200:] & signs[100:140] & signs[150:190])
    ours = [Loops([CHANNELS[1]], scan_above=60) for _ in range(2)]
    for row, each in enumerate(signs[:200]):
        ours[0].update({"features": each}, starts=row == 150)
    ours[1].extend({"features": signs[:200]}, None, np.arange(200) == 150)
    found = [
        [stream.update({"features": each}, starts=not row) for row, each in enumerate(signs[200:])]
        for stream in ours
    ]
    assert [one[:3] for one in found[0]] == [one[:3] for one in found[1]]
    assert sum(one.reason == "accepted" for one in found[0]) > 20
    np.testing.assert_array_equal(ours[0].descriptors("features", 0, 240), signs)


def test_several_threads_find_the_same():
    swept, names = noisy_stream(5, 9000, 110, [4000])
    starts = np.array([a != b for a, b in zip(names, ["", *names], strict=False)])
    results, signs = [], np.array([signs_of(each[0]) for each in swept])
    for threads, above in ((1, SCAN_ABOVE), (3, SCAN_ABOVE), (1, 5000), (3, 5000)):
        stream = Loops(CHANNELS[:2], scan_above=above)
        known = {"ssr-vlad": swept[:8990, 0], "features": signs[:8990]}
        stream.extend(known, None, starts[:8990])
        results.append(
            [
                stream.update({"ssr-vlad": one, "features": other}, threads=threads)
                for one, other in zip(swept[8990:], signs[8990:], strict=True)
            ]
        )
    assert results[0] == results[1]
    assert results[2] == results[3]


def test_what_is_no_descriptor_is_refused_and_leaves_no_trace():
    stream = Loops(CHANNELS[:2])
    one = {"ssr-vlad": PLACES[0], "features": signs_of(PLACES[0])}
    for change, message in (
        ({"ssr-vlad": 2 * PLACES[0]}, "expected descriptors of length 1 or zero"),
        ({"ssr-vlad": math.nan * PLACES[0]}, "expected descriptors of length 1 or zero"),
        ({"ssr-vlad": PLACES[:2]}, "and an odd number of anchors"),
        ({"ssr-vlad": PLACES[0, :9]}, r"ssr-vlad: expected descriptors \(480,\) float32"),
        ({"features": PLACES[0]}, r"features: expected descriptors \(16, 2, 8\) uint8"),
        ({"features": np.zeros((3, 16, 2, 8), np.uint8)}, "and an odd number of anchors"),
    ):
        with pytest.raises(ValueError, match=message):
            stream.update(one | change)
        rows = {name: np.array(each)[None] for name, each in (one | change).items()}
        if rows["ssr-vlad"].ndim == rows["features"].ndim - 2 == 2:
            with pytest.raises(ValueError, match=message):
                stream.extend(rows, None, np.ones(1))
    two, signs = PLACES[:2], np.zeros((2, 16, 2, 8), np.uint8)
    for known, stamps, starts, message in (
        ((two, signs), None, np.zeros(3), r"ssr-vlad: .* of 3 frames, got \(2, 480\)"),
        ((two, signs[:1]), None, np.zeros(2), "features: .* of 2 frames"),
        ((two, signs), np.zeros(1), np.zeros(2), r"stamps: expected shape \(2,\), got \(1,\)"),
        ((two, signs), None, np.zeros((2, 2)), r"starts: expected shape \(2,\), got \(2, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            stream.extend(dict(zip(one, known, strict=True)), stamps, starts)
    assert len(stream) == 0
    for channels, *settings in (
        *(([], 50), ([Channel("x", (0,))], 50), (CHANNELS, -1), (CHANNELS, 50, 2.0)),
        *((CHANNELS, 50, 0.8, -1), (CHANNELS, 50, 0.8, 0)),
    ):
        with pytest.raises(RuntimeError, match="the native core refuses the settings or channels"):
            Loops(channels, *settings)
