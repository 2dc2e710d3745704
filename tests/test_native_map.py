"""The map of the core against `oracles.recognition`, on sequences drawn at random."""

import itertools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import refuses
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_streams import unit
from oracles import recognition as oracle

from ssrvlad_torch.native.map import DescriptorMap, Shortlist

pytestmark = pytest.mark.usefixtures("core")

ROOT = Path(__file__).parents[1]
SEQUENCES = st.lists(st.integers(1, 45), min_size=1, max_size=4)
SEEDS = st.integers(0, 1000)
TRUST = {"shapes": 1.0, "features": 6.0, "hog": 2.0}


def vectors(rng, *shape, common=2.0):
    """Of one sequence: some are zero."""
    drawn = unit(rng.normal(size=shape) + common * rng.normal(size=shape[-1]))
    drawn[rng.random(shape[:-1]) < 0.05] = 0
    return drawn


def named(sequences):
    return [str(number) for number, count in enumerate(sequences) for _ in range(count)]


def fused(scores, weights):
    """``(Q, R)`` of each channel as one, by the oracle."""
    queries = range(len(next(iter(scores.values()))))
    rows = [{name: values[query] for name, values in scores.items()} for query in queries]
    return np.stack([oracle.fused(row, weights) for row in rows])


def town_of(sequences, **channels):
    """A map by some channels."""
    town = DescriptorMap(sequences)
    for name, rows in channels.items():
        town.add(name, rows, TRUST[name])
    return town


def equal(scores, expected):
    assert (np.isfinite(scores) == np.isfinite(expected)).all()
    np.testing.assert_allclose(scores, expected, atol=1e-6, rtol=0)


@given(seed=SEEDS, sequences=SEQUENCES, queries=st.integers(1, 70), standardise=st.booleans())
@settings(max_examples=60)
def test_vectors_are_compared_as_by_the_oracle(seed, sequences, queries, standardise):
    rng = np.random.default_rng(seed)
    there = np.concatenate([vectors(rng, count, 24) for count in sequences])
    here = vectors(rng, queries, 24)
    town = town_of(sequences, shapes=there)
    scores, taken = town.compare({"shapes": here}, standardise)
    assert taken.standardised == (standardise and min(queries, len(there)) >= oracle.MIN_FRAMES)
    sides = here, there
    if taken.standardised:
        names = [""] * queries, named(sequences)
        sides = [oracle.without_means(*side) for side in zip(sides, names, strict=True)]
    equal(scores, oracle.cosines(*sides))


@given(seed=SEEDS, queries=st.integers(12, 50), anchors=st.sampled_from((5, 13)))
def test_of_a_sweep_the_anchors_up_to_its_width_count(seed, queries, anchors):
    rng = np.random.default_rng(seed)
    there, here = vectors(rng, 50, 24), vectors(rng, queries, anchors, 24)
    side = rng.integers(0, anchors // 2 + 1)
    here[:, side] = unit(there[:queries] + 0.1 * rng.normal(size=(queries, 24)))
    scores, taken = town_of([50], shapes=there).compare({"shapes": here}, sweep=True)
    assert taken.width >= anchors // 2 - side
    middle = here[:, anchors // 2 - taken.width : anchors // 2 + taken.width + 1]
    equal(scores, np.max([oracle.cosines(each, there) for each in middle.swapaxes(0, 1)], axis=0))


@pytest.mark.parametrize("equals", ["of the map", "of the queries"])
def test_a_sequence_of_equal_frames_stays_as_it_is(equals):
    rng = np.random.default_rng(0)
    one, others = unit(rng.normal(size=(1, 24))), unit(rng.normal(size=(40, 24)))
    there, here = (one.repeat(40, 0), others)[:: 1 if equals == "of the map" else -1]
    scores, _ = town_of([40], shapes=there).compare({"shapes": here}, True)
    names = ["a"] * 40
    equal(scores, oracle.cosines(*(oracle.without_means(side, names) for side in (here, there))))


@given(
    seed=SEEDS,
    sequences=SEQUENCES,
    queries=st.integers(30, 70),
    shape=st.sampled_from(((8, 3, 4), (2, 1, 1), (1, 1, 9), (3, 5, 8), (5, 8, 16))),
    sweep=st.booleans(),
    standardise=st.booleans(),
)
@settings(max_examples=60)
def test_signs_are_compared_as_by_the_oracle(seed, sequences, queries, shape, sweep, standardise):
    rng = np.random.default_rng(seed)
    there = rng.integers(0, 256, (sum(sequences), *shape), np.uint8)
    here = rng.integers(0, 256, (queries, *shape), np.uint8)
    same = rng.random((2, *shape)) < 0.5
    same[..., 0] = False  # cells of equal signs have no length without their mean
    there, here = (
        np.where(where, signs[:1], signs) for where, signs in zip(same, (there, here), strict=True)
    )
    scores, taken = town_of(sequences, features=there).compare(
        {"features": here}, standardise, sweep
    )
    assert taken.standardised == (standardise and len(there) >= oracle.MIN_FRAMES)
    sides = []
    for signs, names in ((here, [""] * queries), (there, named(sequences))):
        numbers = 2.0 * np.unpackbits(signs, axis=-1, bitorder="little") - 1
        if taken.standardised:
            less = oracle.means_of_sequences(numbers, names)
            numbers -= np.where((np.abs(less) == 1).all((1, 2, 3), keepdims=True), 0, less)
        sides.append(numbers)
    reach = [min(most, count - 1) for most, count in zip((3, 2), shape[:2], strict=True)]
    equal(scores, oracle.cosines_of_signs(*sides, *(reach if sweep else (0, 0))))


@pytest.mark.parametrize("kind", ["vectors", "signs"])
@pytest.mark.parametrize("standardise", [True, False])
def test_rows_of_a_shortlist_lose_the_means_of_their_sequences(kind, standardise):
    """Scores are those of the same rows of the whole map."""
    rng, sequences = np.random.default_rng(0), [33, 40, 31]
    if kind == "vectors":
        there, here, name = vectors(rng, 104, 24), vectors(rng, 40, 24), "shapes"
    else:
        there, here = (rng.integers(0, 256, (n, 6, 2, 4), np.uint8) for n in (104, 40))
        name = "features"
    rows, starts = np.arange(0, 104, 3), np.cumsum([0, *sequences])
    means = np.stack([mean_of(there[a:b]) for a, b in itertools.pairwise(starts)])
    shortlist = Shortlist(rows, np.full(len(rows), 104 / len(rows)), np.array([0, 11, 25]))
    few = DescriptorMap(sequences, shortlist)
    few.add(name, there[rows], means=means if standardise else None)
    whole, _ = town_of(sequences, **{name: there}).compare({name: here}, standardise)
    scores, taken = few.compare({name: here}, standardise)
    assert taken.standardised == standardise
    equal(scores, whole[:, rows])


def mean_of(descriptors):
    """What the rows of a sequence lose, of signs as 1 and -1."""
    if descriptors.dtype == np.uint8:
        return 2.0 * np.unpackbits(descriptors, axis=-1, bitorder="little").mean(0) - 1
    return descriptors[descriptors.any(1)].mean(0, dtype=float)


def channels(rng, sequences, queries):
    """A sequence along a map by three channels."""
    rows = sum(sequences)
    at = (rng.integers(0, rows) + np.arange(queries)) % rows
    places, signs = rng.normal(size=(rows, 24)), rng.integers(0, 256, (rows, 6, 2, 4), np.uint8)
    flipped = rng.integers(0, 256, (queries, 6, 2, 4), np.uint8)
    flipped &= rng.integers(0, 256, flipped.shape, np.uint8)
    there = {"shapes": unit(places + 1), "features": signs, "hog": unit(places - 1)}
    seen = places[at][:, None] + rng.normal(size=(queries, 13, 24))
    noisy = places[at] + 2 * rng.normal(size=(queries, 24))
    here = {"shapes": unit(seen), "features": signs[at] ^ flipped, "hog": unit(noisy)}
    there["shapes"][rng.random(rows) < 0.05] = here["shapes"][rng.random(queries) < 0.05] = 0
    return there, here


@given(
    seed=SEEDS,
    names=st.lists(st.sampled_from([*TRUST]), min_size=2, max_size=3, unique=True),
    queries=st.sampled_from((3, 35, 401)),
    excluded=st.booleans(),
)
@settings(max_examples=30)
def test_channels_are_fused_as_by_the_oracle(seed, names, queries, excluded):
    rng = np.random.default_rng(seed)
    there, here = channels(rng, [40, 33], queries)
    masks = {}
    if excluded:
        first = rng.integers(0, 74, queries)
        ranges = np.stack([first, np.minimum(73, first + 9)], 1)
        masks = {"allowed": rng.random(73) < 0.8, "excluded": ranges}
    rows = np.arange(73)
    scores, width = {}, 0
    for name in names:
        town = town_of([40, 33], **{name: there[name]})
        scores[name], taken = town.compare({name: here[name]}, True, True)
        width = max(width, taken.width)
        if excluded:
            outside = (rows >= ranges[:, :1]) & (rows < ranges[:, 1:])
            scores[name] = np.where(masks["allowed"] & ~outside, scores[name], -np.inf)
    town = town_of([40, 33], **{name: there[name] for name in names})
    together, taken = town.compare({n: here[n] for n in names}, True, True, **masks)
    weights = oracle.weights_of(scores, TRUST)
    assert taken.weights == pytest.approx(weights, abs=1e-5) and taken.width == width
    np.testing.assert_allclose(together, fused(scores, weights), atol=2e-5, rtol=0)


@given(seed=SEEDS, follow=st.sampled_from((None, "offline")))
@settings(max_examples=20)
def test_a_sequence_is_decided_by_the_fused_scores(seed, follow):
    there, here = channels(np.random.default_rng(seed), [40, 33], 35)
    town = town_of([40, 33], **there)
    decision = town.query(here, follow=follow, top=3)
    by_scores = DescriptorMap([40, 33])
    by_scores.add("scores", None)
    scores, taken = town.compare(here, True, True)
    expected = by_scores.query({"scores": scores}, follow=follow, top=3)
    assert decision.taken == taken
    for name in decision._fields[:-1]:
        np.testing.assert_array_equal(getattr(decision, name), getattr(expected, name))


def test_channels_in_another_order_are_tracked_alike():
    there, here = channels(np.random.default_rng(1), [300, 200], 50)
    one, other = (
        town_of([300, 200], **{n: there[n] for n in order}).query(
            {n: here[n] for n in order}, follow="online"
        )
        for order in ([*there], [*there][::-1])
    )
    np.testing.assert_array_equal(one.rows, other.rows)
    np.testing.assert_allclose(one.scores, other.scores, atol=1e-5)
    np.testing.assert_allclose(one.right, other.right, atol=1e-5)


def test_the_channels_of_a_map_are_not_to_be_changed():
    town = town_of([40], shapes=np.eye(40, dtype=np.float32))
    with pytest.raises(TypeError):
        del town.channels["shapes"]


def test_threads_do_not_change_a_bit():
    there, here = channels(np.random.default_rng(0), [300, 200], 50)
    town = town_of([300, 200], **there)
    one, three = (town.query(here, threads=threads) for threads in (1, 3))
    for name in one._fields[:-1]:
        assert np.array_equal(getattr(one, name), getattr(three, name))


def test_more_scores_than_fit_in_memory_come_in_blocks():
    rng = np.random.default_rng(0)
    there, here = vectors(rng, 30_000, 4), vectors(rng, 2300, 4)
    scores, _ = town_of([30_000], shapes=there).compare({"shapes": here})
    some = [2299, 0, 1000]
    equal(scores[some], oracle.cosines(here[some], there))


ZIG = f"{sys.executable} -m ziglang c++ -O3 -target"
PROCESSORS = {
    "SSE2": ("g++ -O2 -DSSRVLAD_SIMD=0", ()),
    "AVX2": ("g++ -O2 -DSSRVLAD_SIMD=1", ()),
    "aarch64": ("aarch64-linux-gnu-g++ -O1 -static -Wno-psabi", ("qemu-aarch64",)),
    "32-bit ARM": ("arm-linux-gnueabihf-g++ -O2 -static -Wno-psabi", ("qemu-arm",)),
    "x86-64 as in the wheel": (f"{ZIG} x86_64-linux-gnu.2.17", ()),
    "aarch64 as in the wheel": (
        f"{ZIG} aarch64-linux-gnu.2.17",
        ("qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"),
    ),
    "Windows as in the wheel": (
        f"{ZIG} x86_64-windows-gnu",
        ("env", f"WINEPREFIX={ROOT}/.cache/wine", "/usr/lib/wine/wine64"),
    ),
}
"""Compilers, and what runs their programs."""


@pytest.fixture(scope="module")
def bits(core, tmp_path_factory):
    """Compiles and runs the program that digests descriptors, scores, decisions and loops: with the
    library of the package, and with the core by another compiler."""
    folder, source = tmp_path_factory.mktemp("bits"), ROOT / "ssrvlad_torch" / "native"
    library = Path(core.library._name)

    def run(compiler, emulator, *sources):
        flags = ["-std=c++17", "-ffp-contract=off", "-pthread", f"-I{source}"]
        files, program = [ROOT / "tests" / "fuzz.cpp", *sources], folder / "fuzz.exe"
        subprocess.run([*compiler.split(), *flags, *files, "-o", program], check=True)
        return subprocess.check_output([*emulator, program, "0", "20", "bits"], text=True)

    here = run("g++ -O2", (), library, f"-Wl,-rpath,{library.parent}")
    assert len(set(here.splitlines())) == 21
    return lambda compiler, emulator: (here, run(compiler, emulator, *source.glob("*.cpp")))


@pytest.mark.slow
@pytest.mark.parametrize("name", PROCESSORS)
def test_all_processors_find_the_same_bits(bits, name):
    compiler, emulator = PROCESSORS[name]
    for program in (compiler.split()[0], *emulator[:1], *emulator[-1:]):
        if not (shutil.which(program) or Path(program).is_dir()):
            pytest.skip(f"{program} is not installed")
    here, there = bits(compiler, emulator)
    assert here == there


def test_the_map_needs_no_torch():
    program = (
        "import sys\n"
        "sys.modules |= dict.fromkeys(('torch', 'kornia', 'lance', 'pyarrow', 'yaml', 'typer'))\n"
        "import numpy as np\n"
        "from ssrvlad_torch.native.map import DescriptorMap\n"
        "frames, town = np.eye(40, dtype=np.float32), DescriptorMap([40])\n"
        "town.add('shapes', frames)\n"
        "print(town.query({'shapes': frames[5:9]}).rows[:, 0].tolist())\n"
    )
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "[5, 6, 7, 8]\n"


def shortlist(rows, weights=(2, 2), means=(0,)):
    listed = Shortlist(np.array(rows), np.array(weights, float), np.array(means))
    return DescriptorMap([9], listed)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda town, _: DescriptorMap([3, 0]), "drives that start before the last row"),
        (lambda town, _: shortlist([3, 2]), "rising rows"),
        (lambda town, _: shortlist([3, 4], weights=(0.5, 1)), "rising rows"),
        (lambda town, _: shortlist([3, 4], means=(1,)), "starts of drives that rise from 0"),
        (lambda town, rows: town.add("a", rows[:3]), "a: expected a row for each of 40 frames"),
        (lambda town, rows: town.add("a", np.where(rows, rows, np.nan)), "a: expected finite rows"),
        (lambda town, rows: town.add("a", rows, 0), "a: expected a trust above 0"),
        (lambda town, rows: town.add("a", rows, 1, rows[:2]), "means of 1 parts of the map"),
        (lambda town, rows: town.query({"hog": rows}), "queries by shapes, got hog"),
        (lambda town, rows: town.query({"shapes": rows[:, None].repeat(2, 1)}), "with an odd S"),
        (lambda town, rows: town.query({"shapes": rows / 0.0}), "finite queries"),
        (lambda town, rows: town.query({"shapes": rows}, top=0), "top: expected at least 1, got 0"),
        (
            lambda town, rows: town.query({"shapes": rows}, follow="on"),
            "follow: expected None, online",
        ),
        (
            lambda town, rows: town.query({"shapes": rows}, excluded=np.full((40, 2), 41)),
            "expected excluded rows of the map",
        ),
        (
            lambda town, rows: (
                town.add("hog", rows),
                town.query({"shapes": rows[:3], "hog": rows}),
            ),
            "one number by all channels, got",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_wrong_use_is_one_line(use, message):
    rows, town = np.eye(40, dtype=np.float32), DescriptorMap([40])
    town.add("shapes", rows)
    refuses(re.escape(message), use, town, rows)
