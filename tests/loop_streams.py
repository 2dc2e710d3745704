"""Streams of descriptors, of label maps and of images as ROS sends them."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
from helpers import street, write_street
from ssrvlad_ros import live_loops

from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.taxonomy import label_space

PLACES = np.eye(480, dtype=np.float32)
"""Descriptors of places, at right angles to each other."""
LIGHT = 3 * PLACES[-1]
RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def drawn_anew():
    """Where a module imports this, what a test draws does not depend on the tests before it."""
    RNG.bit_generator.state = np.random.default_rng(0).bit_generator.state


def views(places, noise=0.002, light=0.0):
    """Descriptors of places, each a little different, with a light that they have in common."""
    return unit(PLACES[np.asarray(places)] + light + RNG.normal(0, noise, (len(places), 480)))


def unit(vectors):
    """Vectors of length 1; zeros stay zeros."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (vectors / np.maximum(lengths, 1e-9)).astype(np.float32)


def noisy_stream(
    seed: int, length: int, places: int, changes: list[int], anchors: int = 1
) -> tuple[npt.NDArray[np.float32], list[str]]:
    """A walk among a few places, forwards, backwards or not at all, with empty frames.

    Returns:
        ``(length, anchors, 480)`` descriptors, and the sequence of each frame, another from each
        of the rows ``changes`` on.
    """
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.choice([-1, 0, 1, 1, 1], length), rng.integers(1, 6, length))[:length]
    where = np.cumsum(steps) % places
    noise = rng.normal(0, rng.choice([0.03, 0.1]), (length, anchors, 120))
    vectors = PLACES[where, None, :120] + noise
    vectors[rng.random(length) < 0.05] = 0
    padded = np.zeros((length, anchors, 480), np.float32)
    padded[..., :120] = unit(vectors)
    sequences = [f"drive {sum(n >= c for c in changes)}" for n in range(length)]
    return padded, sequences


_DRAWN = np.random.default_rng(0).normal(size=(120, 16 * 2 * 64)).astype(np.float32)


def signs_of(descriptor):
    """Signs ``(16, 2, 8)`` uint8 that are as alike as descriptors are."""
    return np.packbits(descriptor[:120] @ _DRAWN > 0).reshape(16, 2, 8)


def hog_of(descriptor):
    """``(480,)`` float32 of length 1 or zero, as alike as descriptors are."""
    return unit(descriptor[:120] @ _DRAWN[:, :480])


SEEDS = (*range(40), *range(10, 24))
"""A drive of forty places that comes back to fourteen of them."""


def write_drive(folder: Path) -> Path:
    """The label maps of `SEEDS`."""
    for number, seed in enumerate(SEEDS):
        write_street(folder / f"{number:02d}.png", seed)
    return folder


def objects(out):
    """The objects that a program prints, one a line."""
    return [json.loads(line) for line in out.splitlines()]


def _likely(candidates):
    return {x["frame"]: x["confidence"] for x in candidates if x["confidence"] > 0.05}


def assert_same_answers(got, expected):
    """Those of two programs, whose scores may differ in their last digits."""
    assert len(got) == len(expected)
    for one, other in zip(got, expected, strict=True):
        assert [*one] == [*other]
        for name in ("frame", "reason", "candidate"):
            assert one[name] == other[name], one["frame"]
        for name in ("score", "confidence"):
            assert one[name] == pytest.approx(other[name], abs=3e-4), one["frame"]
        places, others = (_likely(answer["candidates"]) for answer in (one, other))
        assert places == pytest.approx(others, abs=3e-4), one["frame"]


CAMVID = [(each.id, each.name) for each in label_space("camvid-11").classes]
CONFIG = LoopConfig(exclude=5, sweep=False)
SECOND = 10**9


def picture(pixels, encoding="mono8", padding=0, big=0):
    """A ``sensor_msgs/Image``, of a label map or of a picture."""
    dtype = live_loops.DTYPES.get(encoding, "u1")
    stored = pixels.astype(dtype.replace("u", ">u" if big else "<u"))
    rows = [row.tobytes() + b"\x63" * padding for row in stored]
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=big,
        step=stored[0].nbytes + padding,
        data=b"".join(rows),
    )


def updates(core, seeds=SEEDS, start=0):
    """What a core says of a drive, a frame a second."""
    return [
        core.update(picture(street(seed)), number * SECOND, (number, -1.0, 0.5))
        for number, seed in enumerate(seeds, start)
    ]


def seen(core, seeds=SEEDS, start=0):
    """The results of `updates`."""
    return [update.result for update in updates(core, seeds, start)]
