"""The map of the core against `recognition.reference`, on drives drawn at random."""

import itertools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_streams import unit

from ssrvlad_torch.native.decide import decide
from ssrvlad_torch.native.map import MIN_FRAMES, Map, match
from ssrvlad_torch.recognition import reference
from ssrvlad_torch.search.sums import sums

pytestmark = pytest.mark.usefixtures("core")

ROOT = Path(__file__).parents[1]
DRIVES = st.lists(st.integers(1, 45), min_size=1, max_size=4)
SEEDS = st.integers(0, 1000)
TRUST = {"shapes": 1.0, "features": 6.0, "hog": 2.0}


def vectors(rng, *shape, common=2.0):
    """Of one drive: some are zero."""
    drawn = unit(rng.normal(size=shape) + common * rng.normal(size=shape[-1]))
    drawn[rng.random(shape[:-1]) < 0.05] = 0
    return drawn


def named(drives):
    return [str(number) for number, count in enumerate(drives) for _ in range(count)]


def fused(scores, weights):
    """``(Q, R)`` of each channel as one, by the oracle."""
    queries = range(len(next(iter(scores.values()))))
    each = [{name: of[query] for name, of in scores.items()} for query in queries]
    return np.stack([reference.fused(one, weights) for one in each])


def whole(comparison):
    return np.stack([comparison[query] for query in range(len(comparison))])


def equal(got, expected):
    assert (np.isfinite(got) == np.isfinite(expected)).all()
    np.testing.assert_allclose(got, expected, atol=1e-6, rtol=0)


@given(
    seed=SEEDS,
    drives=DRIVES,
    queries=st.integers(1, 70),
    anchors=st.sampled_from((1, 5, 13)),
    sweep=st.booleans(),
    standardise=st.booleans(),
)
@settings(max_examples=60)
def test_vectors_are_compared_as_by_the_reference(
    seed, drives, queries, anchors, sweep, standardise
):
    rng = np.random.default_rng(seed)
    there = np.concatenate([vectors(rng, count, 24) for count in drives])
    here = vectors(rng, queries, anchors, 24)
    here[:, anchors // 2] = unit(here[:, anchors // 2] + vectors(rng, queries, 24))
    town = Map(drives)
    town.add("shapes", there)
    standardised = standardise and min(queries, len(there)) >= MIN_FRAMES
    found = town.compare("shapes", here, standardised, sweep)
    expected, width = reference.compare_vectors(here, there, named(drives), standardised, sweep)
    assert found.width == width
    equal(whole(found), expected)


@pytest.mark.parametrize("equals", ["of the map", "of the queries"])
def test_a_drive_of_equal_frames_stays_as_it_is(equals):
    rng = np.random.default_rng(0)
    one, others = unit(rng.normal(size=(1, 24))), unit(rng.normal(size=(40, 24)))
    same = one.repeat(40, 0)
    there, here = (same, others) if equals == "of the map" else (others, same)
    town = Map([40])
    town.add("shapes", there)
    found = whole(town.compare("shapes", here, True, False))
    expected, _ = reference.compare_vectors(here[:, None], there, ["a"] * 40, True, False)
    equal(found, expected)


@given(
    seed=SEEDS,
    drives=DRIVES,
    queries=st.integers(30, 70),
    shape=st.sampled_from(((8, 3, 4), (2, 1, 1), (1, 9), (3, 8))),
    sweep=st.booleans(),
    standardise=st.booleans(),
)
@settings(max_examples=60)
def test_signs_are_compared_as_by_the_reference(seed, drives, queries, shape, sweep, standardise):
    rng = np.random.default_rng(seed)
    there = rng.integers(0, 256, (sum(drives), *shape), np.uint8)
    here = rng.integers(0, 256, (queries, *shape), np.uint8)
    same = rng.random((2, *shape)) < 0.5
    same[..., 0] = False  # columns of equal signs have no length without their mean
    sides = [np.where(each, some[:1], some) for each, some in zip(same, (there, here), strict=True)]
    town = Map(drives)
    town.add("features", sides[0])
    standardised = standardise and len(there) >= MIN_FRAMES
    found = town.compare("features", sides[1], standardised, sweep)
    expected = reference.compare_signs(*sides[::-1], named(drives), standardised, sweep)
    equal(whole(found), expected)
    assert found.width == 0


@given(
    seed=SEEDS,
    kind=st.sampled_from(("vectors", "swept", "signs")),
    sweep=st.booleans(),
    width=st.integers(0, 2),
)
def test_some_rows_and_queries_of_drives_lose_the_means_of_all(seed, kind, sweep, width):
    """Scores are those of all rows and queries, at the same width of the sweep."""
    rng, drives, count, vector = np.random.default_rng(seed), [33, 40, 31], 40, kind != "signs"
    town, few = Map(drives), Map([11, 14, 10])
    if vector:
        there = vectors(rng, sum(drives), 24)
        here = vectors(rng, *((count, 5) if kind == "swept" else (count, 1)), 24)
        here = here[:, 2 - width : 3 + width] if kind == "swept" else here
    else:
        there, here = (rng.integers(0, 256, (n, 6, 2, 4), np.uint8) for n in (sum(drives), count))
    town.add("x", there)
    some, part = np.arange(0, len(there), 3), slice(9, 16)
    starts = np.cumsum([0, *drives])
    means = np.stack([mean_of(there[a:b]) for a, b in itertools.pairwise(starts)])
    few.add("x", there[some], means=means)
    mean, names = mean_of(here.reshape(-1, 24) if vector else here), named(drives)
    found = few.compare("x", here[part], True, sweep or vector, mean=mean)
    assert found.width == (here.shape[1] // 2 if vector else 0)
    own = means[[int(name) for name in np.array(names)[some]]]
    if vector:
        expected, _ = reference.compare_vectors(
            here[part], there[some], names, True, True, own, mean
        )
    else:
        expected = reference.compare_signs(here[part], there[some], names, True, sweep, own, mean)
    equal(whole(found), expected)
    if kind != "swept":
        every = town.compare("x", here, True, sweep)
        equal(whole(found), whole(every)[part][:, some])
    zeros = few.compare("x", here[part], False, sweep or vector, mean=np.zeros_like(mean))
    if kind != "swept":
        equal(whole(zeros), whole(town.compare("x", here, False, sweep))[part][:, some])


def mean_of(descriptors):
    total, counted = sums(torch.from_numpy(descriptors))
    return total / max(1, counted)


def test_equal_signs_stay_as_they_are():
    rng = np.random.default_rng(0)
    one, others = (rng.integers(0, 256, (n, 4, 8), np.uint8) for n in (1, 40))
    town = Map([40])
    town.add("features", one.repeat(40, 0))
    assert whole(town.compare("features", one.repeat(30, 0), True, False)) == pytest.approx(1)
    assert whole(town.compare("features", others, True, False)).std() > 0


def channels(rng, drives, queries):
    """A drive along a map by three channels."""
    rows = sum(drives)
    at = (rng.integers(0, rows) + np.arange(queries)) % rows
    places, signs = rng.normal(size=(rows, 24)), rng.integers(0, 256, (rows, 6, 8), np.uint8)
    flipped = rng.integers(0, 256, (queries, 6, 8), np.uint8)
    flipped &= rng.integers(0, 256, flipped.shape, np.uint8)
    there = {"shapes": unit(places + 1), "features": signs, "hog": unit(places - 1)}
    seen = places[at][:, None] + rng.normal(size=(queries, 13, 24))
    noisy = places[at] + 2 * rng.normal(size=(queries, 24))
    here = {"shapes": unit(seen), "features": signs[at] ^ flipped, "hog": unit(noisy)}
    there["shapes"][rng.random(rows) < 0.05] = here["shapes"][rng.random(queries) < 0.05] = 0
    return there, here


@given(
    seed=SEEDS,
    drives=DRIVES,
    queries=st.integers(1, 60),
    names=st.lists(st.sampled_from([*TRUST]), min_size=1, max_size=3, unique=True),
    follow=st.sampled_from((None, "online", "offline")),
    steps=st.tuples(st.booleans(), st.booleans()),
)
@settings(max_examples=60)
def test_a_drive_is_found_by_all_channels_as_one(seed, drives, queries, names, follow, steps):
    rng = np.random.default_rng(seed)
    there, here = channels(rng, drives, queries)
    town = Map(drives)
    for name in names:
        town.add(name, there[name], TRUST[name])
    delay = 2 if follow == "online" else 0
    found = town.query({name: here[name] for name in names}, *steps, follow, delay, top=3)
    standardised = steps[0] and min(queries, len(town)) >= MIN_FRAMES
    compared = {name: town.compare(name, here[name], standardised, steps[1]) for name in names}
    scores = {name: whole(each) for name, each in compared.items()}
    weights = reference.weights_of(scores, TRUST)
    assert found.weights == pytest.approx(weights, abs=1e-6)
    assert (found.standardised, found.width) == (
        standardised,
        max(each.width for each in compared.values()),
    )
    together = fused(scores, weights) if len(names) > 1 else scores[names[0]]
    starts = np.cumsum([0, *drives[:-1]]).tolist()
    expected = decide(together.astype(np.float32), starts, len(town), follow, delay, 3)
    got = found.decision
    assert got.followed == expected.followed
    assert (got.way, got.rate, got.streams) == (expected.way, expected.rate, expected.streams)
    for name in ("scores", "right", "spread", "together"):
        equal_sure(getattr(got, name), getattr(expected, name))
    assert np.mean(got.rows == expected.rows) > 0.99  # of equal scores another may come first


def equal_sure(got, expected):
    """Confidence and beliefs hold sums of thousands of scores in single precision."""
    assert (np.isfinite(got) == np.isfinite(expected)).all()
    np.testing.assert_allclose(got, expected, atol=2e-5, rtol=0)


@given(
    seed=SEEDS,
    names=st.sampled_from((("shapes", "hog"), [*TRUST])),
    queries=st.sampled_from((35, 401)),
)
def test_scores_of_channels_are_fused_as_by_the_reference(seed, names, queries):
    there, here = channels(np.random.default_rng(seed), [40, 33], queries)
    town = Map([40, 33])
    for name in names:
        town.add(name, there[name], TRUST[name])
    found = town.query({name: here[name] for name in names}, follow=None, top=len(town))
    scores = {name: whole(town.compare(name, here[name], True, True)) for name in names}
    expected = fused(scores, reference.weights_of(scores, TRUST))
    got = np.full_like(expected, -np.inf)
    for query, (values, rows) in enumerate(zip(*found.decision[:2], strict=True)):
        got[query, rows[rows >= 0]] = values[rows >= 0]
    equal(got, expected)


def test_threads_do_not_change_a_bit():
    rng = np.random.default_rng(0)
    there, here = channels(rng, [300, 200], 50)
    town = Map([300, 200])
    for name, trust in TRUST.items():
        town.add(name, there[name], trust)
    one, three = (town.query(here, threads=threads).decision for threads in (1, 3))
    for some, other in zip(one, three, strict=True):
        assert np.array_equal(some, other)


def test_more_scores_than_fit_in_memory_come_in_blocks():
    rng = np.random.default_rng(0)
    there, here = vectors(rng, 30_000, 4), vectors(rng, 2300, 4)
    town = Map([30_000])
    town.add("shapes", there)
    found = town.compare("shapes", here, False, False)
    expected, _ = reference.compare_vectors(
        here[[2299, 0, 1000], None], there, [""] * 30_000, False, False
    )
    equal(np.stack([found[query] for query in (2299, 0, 1000)]), expected)


PROCESSORS = {
    "SSE2": ("g++ -O2 -DSSRVLAD_SIMD=0", ()),
    "AVX2": ("g++ -O2 -DSSRVLAD_SIMD=1", ()),
    "aarch64": ("aarch64-linux-gnu-g++ -O1 -static -Wno-psabi", ("qemu-aarch64",)),
    "32-bit ARM": ("arm-linux-gnueabihf-g++ -O2 -static -Wno-psabi", ("qemu-arm",)),
}
"""Compilers, and what runs their programs."""


@pytest.fixture(scope="module")
def bits(core, tmp_path_factory):
    """Compiles and runs the program that prints scores, decisions and loops, bit by bit: with the
    library of the package, and with the core by another compiler."""
    folder, source = tmp_path_factory.mktemp("bits"), ROOT / "ssrvlad_torch" / "native"
    library = Path(core.library._name)

    def run(compiler, emulator, *sources):
        flags = ["-std=c++17", "-ffp-contract=off", "-pthread", f"-I{source}"]
        given = [ROOT / "tests" / "bits.cpp", *sources]
        subprocess.run([*compiler.split(), *flags, *given, "-o", folder / "bits"], check=True)
        return subprocess.check_output([*emulator, folder / "bits"])

    here = run("g++ -O2", (), library, f"-Wl,-rpath,{library.parent}")
    assert len(here.splitlines()) > 9000 and b"nan" not in here
    return lambda compiler, emulator: (here, run(compiler, emulator, *source.glob("*.cpp")))


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n != "aarch64" else ()) for n in PROCESSORS]
)
def test_all_processors_find_the_same_bits(bits, name):
    compiler, emulator = PROCESSORS[name]
    for program in (compiler.split()[0], *emulator):
        if not shutil.which(program):
            pytest.skip(f"{program} is not installed")
    here, there = bits(compiler, emulator)
    assert here == there


def test_the_map_needs_no_torch():
    program = (
        "import sys; sys.modules['torch'] = None\n"
        "import numpy as np\n"
        "from ssrvlad_torch.native.map import Map\n"
        "frames, town = np.eye(40, dtype=np.float32), Map([40])\n"
        "town.add('shapes', frames)\n"
        "print(town.query({'shapes': frames[5:9]}).decision.rows[:, 0].tolist())\n"
    )
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "[5, 6, 7, 8]\n"


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda town, _: Map([3, 0]), "drives of at least 1 frame, got [3, 0]"),
        (lambda town, rows: town.add("a", rows[:3]), "a: expected a row for each of 40 frames"),
        (lambda town, rows: town.add("shapes", rows), "shapes: expected a name that is new"),
        (lambda town, rows: town.add("a", rows.astype(int)), "a: expected vectors of float32 or"),
        (lambda town, rows: town.add("a", np.where(rows, rows, np.nan)), "a as finite rows"),
        (lambda town, rows: town.add("a", rows, 0), "trust above 0, got (40, 40), trust 0"),
        (lambda town, rows: town.query({"hog": rows}), "queries by shapes, got hog"),
        (lambda town, rows: town.query({"shapes": rows[:, :9]}), "(Q, 40) float32, of vectors"),
        (lambda town, rows: town.query({"shapes": rows[:, None].repeat(2, 1)}), "with an odd S"),
        (lambda town, rows: town.query({"shapes": rows / 0.0}), "finite queries"),
        (lambda town, rows: town.query({"shapes": rows}, top=0), "top: expected at least 1, got 0"),
        (
            lambda town, rows: town.query({"shapes": rows}, follow="on"),
            "follow: expected None, online",
        ),
        (lambda town, rows: town.compare("shapes", rows / 0.0, True, True), "finite queries"),
        (
            lambda town, rows: (
                town.add("hog", rows),
                town.query({"shapes": rows[:3], "hog": rows}),
            ),
            "one number of queries by all channels, got",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_wrong_use_is_one_line(use, message):
    rows, town = np.eye(40, dtype=np.float32), Map([40])
    town.add("shapes", rows)
    refuses(re.escape(message), use, town, rows)


def test_a_row_of_length_zero_matches_nothing():
    rows = np.eye(4, dtype=np.float32)
    best = np.full((1, 4), -np.inf, np.float32), np.full((1, 4), -1)
    match(rows[:1], (rows, np.float32([0, 1, 1, 1])), 0, None, 1, best)
    assert best[1].tolist() == [[1, 2, 3, -1]] and not best[0][0, :3].any()


def test_sums_of_products_are_rounded_once(tmp_path):
    """On every processor: a sum near the middle of two numbers, and numbers with few digits."""
    folder = ROOT / "ssrvlad_torch" / "native"
    (tmp_path / "once.cpp").write_text(ONCE)
    flags = ["-std=c++17", "-O1", "-ffp-contract=off", f"-I{folder}"]
    sources = [tmp_path / "once.cpp", folder / "products.cpp"]
    for more in ([], ["-DSSRVLAD_SIMD=0"]):
        subprocess.run(["g++", *flags, *more, *sources, "-o", tmp_path / "once"], check=True)
        subprocess.run([tmp_path / "once"], check=True)


ONCE = r"""
#include "products.hpp"

int main() {
  const float above = 1 + std::ldexp(1.0F, -23), half = std::ldexp(1 - std::ldexp(1.0F, -23), -24);
  const float some[][2] = {{1, above}, {std::ldexp(1.0F, -70), std::ldexp(3.0F, -75)}};
  const float others[][2] = {{above, half}, {std::ldexp(above, -66), std::ldexp(above, -70)}};
  for (int each = 0; each < 2; ++each) {
    float sum;
    places::Panels(some[each], 1, 1, 2).best(others[each], 1, &sum, 1);
    const float first = some[each][0] * others[each][0];
    if (sum != std::fma(some[each][1], others[each][1], first)) return 1;
  }
}
"""
