"""The live stream of the native core: held to the oracle on random streams, what changes nothing,
and what is refused."""

import math
import resource
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_streams import LIGHT, PLACES, hog_of, noisy_stream, signs_of, unit, views
from oracles import loops as oracle
from test_crashes import limited

from ssrvlad_torch.native.loops import Channel, Loops, Reason

pytestmark = pytest.mark.usefixtures("core")

SHAPES = Channel("ssr-vlad", (480,))
SIGNS = Channel("features", (16, 2, 8), "uint8", 6.0)
VECTORS = Channel("hog", (480,), "float32", 2.0)


def described(vectors, *channels):
    """Descriptors of frames by channels, from those of label maps ``(N, 480)``."""
    forms = {"features": signs_of, "hog": hog_of, "ssr-vlad": lambda vector: vector}
    return {channel.name: np.array([*map(forms[channel.name], vectors)]) for channel in channels}


def rows_of(frames, rows):
    return {name: array[rows] for name, array in frames.items()}


def run(stream, frames, starts, **settings):
    """The steps of a stream over frames ``(N, ...)`` by channel."""
    return [
        stream.update(rows_of(frames, row), starts=starts[row], **settings)
        for row in range(len(starts))
    ]


def assert_as_the_oracle(frames, starts, channels, earlier=0, exclude=50, threshold=0.8):
    """Runs both over frames, of which the first come earlier; returns the steps of the core. What
    is decided is equal, but where rounding decides."""
    core, plain = (form(channels, exclude, threshold) for form in (Loops, oracle.Loops))
    anchors = frames["ssr-vlad"].reshape(len(starts), -1, 480)
    centres = frames | {"ssr-vlad": anchors[:, anchors.shape[1] // 2]}
    first = rows_of(centres, slice(earlier))
    core.extend(first, None, starts[:earlier])
    plain.extend(first, starts[:earlier])
    steps = []
    for row in range(earlier, len(starts)):
        frame = rows_of(frames, row)
        step = core.update(frame, starts=starts[row])
        steps.append(step)
        reason, candidate, score, probability, places = plain.update(frame, starts[row])
        assert core.weights == pytest.approx(plain.weights, abs=1e-4)
        if candidate is None:
            assert (step.reason, step.candidate) == (reason, None)
            continue
        likely = plain.model().rows(plain.states)
        assert likely[step.candidate] == pytest.approx(likely[candidate], abs=2e-5)
        if step.candidate == candidate and abs(probability - threshold) > 1e-4:
            assert (step.reason == "accepted") == (reason == "accepted")
            assert (step.score, step.probability) == pytest.approx((score, probability), abs=2e-5)
            top = [chance for _, chance in step.places]
            assert top == pytest.approx([chance for _, chance in places[: len(top)]], abs=2e-5)
    return steps


@st.composite
def streams(draw):
    """A walk with empty frames, in up to three sequences; frames that are known."""
    anchors, length = draw(st.sampled_from([1, 3, 5])), draw(st.integers(1, 160))
    seed, places = draw(st.integers(0, 2**31)), draw(st.integers(2, 80))
    changes = draw(st.lists(st.integers(0, 160), max_size=2))
    swept, names = noisy_stream(seed, length, places, changes, anchors)
    light = np.random.default_rng(seed).normal(0, 0.3, (3, 480)).astype(np.float32)
    sequence = np.array([int(name.split()[1]) for name in names])
    full = swept.any(axis=2)
    swept[full] = unit((swept + draw(st.booleans()) * light[sequence][:, None])[full])
    channels = [SHAPES, *draw(st.lists(st.sampled_from([SIGNS, VECTORS]), unique=True))]
    frames = described(swept[:, anchors // 2], *channels) | {"ssr-vlad": swept}
    settings = {"earlier": draw(st.integers(0, length)), "exclude": draw(st.integers(0, 60))}
    settings["threshold"] = draw(st.sampled_from([0.3, 0.8]))
    return frames, np.diff(sequence, prepend=-1) > 0, channels, settings


@given(streams())
def test_the_core_finds_what_the_oracle_finds(stream):
    *arguments, settings = stream
    assert_as_the_oracle(*arguments, **settings)


def count(steps, reason=Reason.ACCEPTED):
    return sum(step.reason == reason for step in steps)


STREET = PLACES[:300] + PLACES[1:301]


def test_a_return_in_another_light_is_that_of_the_oracle():
    """Without a gap, by all channels: the tracks of the stream tell it."""
    drawn = np.random.default_rng(0).normal(0, 0.3 / 22, (230, 480))
    vectors = unit(np.concatenate((STREET[:150], STREET[40:120] + 0.35 * LIGHT)) + drawn)
    channels = [SHAPES, SIGNS, VECTORS]
    steps = assert_as_the_oracle(described(vectors, *channels), np.arange(230) == 0, channels)
    assert count(steps[150:]) > 30


def test_an_empty_frame_is_no_place_whatever_other_channels_see():
    """The first 20 frames of a street have no label map; then the whole street comes again."""
    channels = [SHAPES, SIGNS]
    frames = described(unit(STREET[:80])[[*range(80)] * 2], *channels)
    frames["ssr-vlad"][:20] = 0
    steps = assert_as_the_oracle(frames, np.arange(160) % 80 == 0, channels)[80:]
    assert min(step.candidate for step in steps) >= 20
    assert count(steps[:20]) == 0 and count(steps[20:]) > 40


def test_a_frame_is_empty_where_the_first_channel_is_zero_signs_too():
    signs = np.random.default_rng(0).integers(0, 256, (40, 16, 2, 8), np.uint8)
    signs[[0, 7, 39]] = 0
    steps = run(Loops([SIGNS], exclude=5), {"features": signs}, np.arange(40) == 0)
    empty = [row for row, step in enumerate(steps) if step.reason == Reason.EMPTY_FRAME]
    assert empty == [0, 7, 39]
    assert not {step.candidate for step in steps} & {0, 7}


@pytest.mark.parametrize("channels", [[SHAPES, SIGNS], [SHAPES]])
def test_an_old_sequence_is_left_where_it_fits_no_longer(channels):
    """Forty frames at old places, then forty at new ones. Label maps alone fit too unevenly."""
    vectors = views([*range(100), *range(20, 60), *range(200, 240)], 0.02)
    steps = run(Loops(channels), described(vectors, *channels), np.arange(180) % 100 == 0)
    assert count(steps[110:140]) == 30
    assert count(steps[142:]) == 0 or channels == [SHAPES]


@pytest.mark.parametrize("earlier", [0, 50])
def test_two_passes_of_a_street_are_one_place_to_the_third(earlier):
    """The second pass closed loops with the first one, whose frames came or were known."""
    channels = [SHAPES, SIGNS]
    noise = np.random.default_rng(0).normal(0, 0.02, (150, 480))
    frames = described(unit(PLACES[[*range(50)] * 3] + noise), *channels)
    steps = assert_as_the_oracle(frames, np.arange(150) % 50 == 0, channels, earlier, 25)
    assert count(steps[-40:]) > 35 and not count(steps, Reason.AMBIGUOUS)
    assert all((100 + row - step.candidate) % 50 == 0 for row, step in enumerate(steps[-40:], 10))


# ---- what changes nothing


def stream_of(length, *channels):
    """Two passes of a noisy walk by channels, and where they start."""
    vectors, names = noisy_stream(5, length, 110, [length // 2])
    starts = np.array([a != b for a, b in zip(names, ["", *names], strict=False)])
    return described(vectors[:, 0], *channels), starts


@pytest.mark.parametrize("scan_above", [50_000, 500])
def test_the_number_of_threads_changes_no_bit(scan_above):
    """Also where more rows are compared than one thread takes at once."""
    frames, starts = stream_of(9000, SHAPES, SIGNS)
    steps = []
    for threads in (1, 3):
        stream = Loops([SHAPES, SIGNS], scan_above=scan_above)
        stream.extend(rows_of(frames, slice(8990)), None, starts[:8990])
        last = rows_of(frames, slice(8990, None))
        steps.append(run(stream, last, starts[8990:], threads=threads))
    assert steps[0] == steps[1]


def test_descriptors_come_back_as_they_were_given():
    """Over the ends of blocks of rows."""
    frames, starts = stream_of(1110, SHAPES, SIGNS)
    stream = Loops([SHAPES, SIGNS])
    stream.extend(rows_of(frames, slice(1100)), None, starts[:1100])
    run(stream, rows_of(frames, slice(1100, None)), starts[1100:])
    assert len(stream) == 1110
    for name, array in frames.items():
        np.testing.assert_array_equal(stream.descriptors(name, 0, 1110), array)
        np.testing.assert_array_equal(stream.descriptors(name, 1020, 1105), array[1020:1105])


@pytest.mark.parametrize("earlier", [0, 460])
def test_a_large_memory_closes_most_loops_of_a_small_one(earlier):
    """Most rows have rough scores alone. A street of 400 places, of which the last 100 come again,
    whether its frames came or were known."""
    rng, rows = np.random.default_rng(0), [*range(400), *range(300, 400)]
    signs = rng.integers(0, 256, (400, 16, 2, 8), np.uint8)[rows]
    signs ^= np.bitwise_and.reduce(rng.integers(0, 256, (3, *signs.shape), np.uint8))
    vectors = unit(unit(rng.normal(size=(400, 480)))[rows] + rng.normal(0, 0.02, (500, 480)))
    frames = {"ssr-vlad": vectors, "features": signs}
    loops = []
    for scan_above in (50_000, 250):
        stream = Loops([SHAPES, SIGNS], scan_above=scan_above)
        stream.extend(rows_of(frames, slice(earlier)), None, np.arange(earlier) == 0)
        starts = np.arange(earlier, 500) % 400 == 0
        steps = run(stream, rows_of(frames, slice(earlier, None)), starts)
        loops.append(
            {r: s.candidate for r, s in enumerate(steps, earlier) if s.reason == "accepted"}
        )
    small, large = loops
    assert len(large) > max(30, 0.8 * len(small))
    assert {row - candidate for row, candidate in (small | large).items()} == {100}


def test_rows_that_are_compared_now_and_then_have_the_scores_of_those_that_always_are():
    """By signs alone, most of them roughly; some frames were known, and there are three drives."""
    frames, starts = stream_of(300, SIGNS)
    starts[50] = True
    pairs = []
    for scan_above in (50_000, 20):
        stream = Loops([SIGNS], exclude=10, scan_above=scan_above)
        stream.extend(rows_of(frames, slice(30)), None, starts[:30])
        pairs.append(run(stream, rows_of(frames, slice(30, None)), starts[30:]))
    same = [
        (one.score, other.score)
        for one, other in zip(*pairs, strict=True)
        if one.reason == other.reason == Reason.ACCEPTED and one.candidate == other.candidate
    ]
    assert len(same) > 3
    np.testing.assert_allclose(*zip(*same, strict=True), atol=2e-6)


# ---- what is refused


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"ssr-vlad": 2 * PLACES[0]}, "expected finite vectors of length 1 or 0"),
        ({"ssr-vlad": math.nan * PLACES[0]}, "expected finite vectors of length 1 or 0"),
        ({"ssr-vlad": PLACES[:2]}, "from an odd number of anchors"),
        ({"ssr-vlad": PLACES[0, :9]}, r"ssr-vlad: expected an array \(1, 480\) of float32"),
        ({"ssr-vlad": PLACES[0].astype(float)}, r"of float32 on cpu, got \(1, 480\) of float64"),
        ({"features": PLACES[0]}, r"features: expected an array .* of uint8 on cpu, got"),
        ({"features": np.zeros((3, 16, 2, 8), np.uint8)}, "from an odd number of anchors"),
    ],
)
def test_what_is_no_descriptor_is_refused_and_leaves_no_trace(wrong, message):
    stream = Loops([SHAPES, SIGNS])
    with pytest.raises(ValueError, match=message):
        stream.update({"ssr-vlad": PLACES[0], "features": signs_of(PLACES[0])} | wrong)
    assert len(stream) == 0


def test_after_memory_was_short_a_stream_keeps_its_frames_and_takes_no_more():
    """One channel has the frame already, the other has no memory for 1024 such."""
    stream = Loops([SHAPES, Channel("wide", (1 << 16,))])
    frame = {"ssr-vlad": PLACES[0], "wide": np.eye(1, 1 << 16, dtype=np.float32)[0]}
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (1 << 26)
    with limited(resource.RLIMIT_AS, most), pytest.raises(MemoryError):
        stream.update(frame)
    frames = {name: array[None] for name, array in frame.items()}
    for take in (partial(stream.update, frame), partial(stream.extend, frames, None, np.ones(1))):
        with pytest.raises(ValueError, match="memory was not enough for an earlier call"):
            take()
    assert stream.descriptors("ssr-vlad", 0, len(stream)).shape == (0, 480)
