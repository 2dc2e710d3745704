"""The C functions of the core on wrong arguments: a status and a reason, and no crash."""

import ctypes
import json

import numpy as np
import pytest
from helpers import outcome

from ssrvlad_torch.config import CHOICES, PRESETS, SSRVLADConfig
from ssrvlad_torch.native import FOLDER, LIBRARY, last_error
from ssrvlad_torch.native.headers import number, struct
from ssrvlad_torch.native.loops import Channel, Loops
from ssrvlad_torch.native.map import DescriptorMap
from ssrvlad_torch.native.operator import _Head, settings_of
from ssrvlad_torch.native.tracker import DescriptorTracker

FOUND, NUMBERS, PLANES = np.empty(8), np.full(4, 0.5), np.zeros((16, 16), np.uint8)
FRAMES, START, MANY = np.eye(4, 8, dtype=np.float32), np.zeros(1, np.int64), 1 << 62
INTERFACE = number("INTERFACE")


def of(array):
    return array.ctypes.data


def decided(starts, scores):
    def call(core):
        drives = struct("drives")(starts, 1, 4)
        handle = ctypes.c_void_p(core.ssrvlad_map_new_for(INTERFACE, drives))
        if not handle:
            return -2
        core.ssrvlad_map_add_channel(handle, struct("channel")(None, 2, 1, 1, 1, 1.0))
        steps, done = struct("steps")(0, 0, 2, 0, 1), struct("taken")(0, 0, of(FOUND))
        passed, room = struct("queries")(of(FRAMES), 1), struct("decision")(scores)
        status = core.ssrvlad_map_query(handle, passed, 1, steps, 1, room, done)
        core.ssrvlad_map_free(handle)
        return status

    return call


def channel(kind, columns, size):
    def add(core):
        drives = struct("drives")(of(START), 1, 4)
        town = ctypes.c_void_p(core.ssrvlad_map_new_for(INTERFACE, drives))
        rows = struct("channel")(of(FRAMES), kind, columns, 1, size, 1.0)
        status = core.ssrvlad_map_add_channel(town, rows)
        core.ssrvlad_map_free(town)
        return status

    return add


def described(core):
    labels, settings = struct("labels")(of(PLANES), 1, MANY, 16, 16), struct("settings")()
    table = struct("table")(of(PLANES), 9, 0)
    core.ssrvlad_preset(b"default", ctypes.byref(settings))
    head = ctypes.c_void_p(core.ssrvlad_new_for(INTERFACE, settings))
    status = core.ssrvlad_describe(head, labels, table, 1, of(FOUND))
    core.ssrvlad_free(head)
    return status


CALLS = {
    "a preset without memory": lambda core: core.ssrvlad_preset(b"default", None),
    "too many label maps": described,
    "drives without starts": decided(None, of(FOUND)),
    "a decision without memory": decided(of(START), None),
    "a channel of too long vectors": channel(0, 1, 1 << 61),
    "a channel of too many signs": channel(1, 1 << 32, 1 << 31),
    "a channel of more signs than are counted": channel(1, 1 << 16, 1 << 15),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_argument_is_a_status(name, core):
    assert CALLS[name](core.library) == -2


def test_where_memory_runs_short_the_status_says_so_and_the_stream_goes_on(core):
    shape, settings = (ctypes.c_int64 * 3)(1 << 20, 1, 1), struct("loops_settings")(2, 0.8, 5000)
    channel = struct("loops_channel")(0, shape, 1.0)
    loops = core.library.ssrvlad_loops_new_for(INTERFACE, settings, channel, 1)
    handle, reserve = ctypes.c_void_p(loops), core.library.ssrvlad_loops_reserve
    assert [reserve(handle, frames) for frames in (1 << 40, 9)] == [number("NO_MEMORY"), 0]
    core.library.ssrvlad_loops_free(handle)


@pytest.mark.parametrize("name", ["map", "tracker", "loops", "operator"])
def test_what_cannot_be_made_for_want_of_memory_is_a_memory_error(name, core, monkeypatch):
    town = DescriptorMap([3])
    town.add("x", None)
    stream = Loops([Channel("x", (1 << 20,))])
    make = {
        "map": lambda: DescriptorMap([3]),
        "tracker": lambda: DescriptorTracker(town),
        "loops": lambda: Loops([Channel("x", (3,))]),
        "operator": lambda: _Head.__wrapped__(json.dumps(SSRVLADConfig().to_dict())),
    }[name]
    for function in ("map_new_for", "tracker_new_for", "loops_new_for", "new_for"):
        monkeypatch.setattr(core.library, f"ssrvlad_{function}", lambda *_: None)
    core.library.ssrvlad_loops_reserve(stream._handle, 1 << 40)
    with pytest.raises(MemoryError, match="not enough memory"):
        make()


def test_a_tracker_that_memory_was_short_for_refuses_all(core):
    """Of more candidates than there is memory for."""
    drives, steps = struct("drives")(of(START), 1, 4), struct("steps")(0, 0, 1, 0, MANY)
    town = ctypes.c_void_p(core.library.ssrvlad_map_new_for(INTERFACE, drives))
    core.library.ssrvlad_map_add_channel(town, struct("channel")(None, 2, 1, 1, 1, 1.0))
    tracker = ctypes.c_void_p(core.library.ssrvlad_tracker_new_for(INTERFACE, town, steps))
    passed = struct("queries")(of(FRAMES), 1)
    taken, query = struct("taken")(0, 0, of(FOUND)), ctypes.byref(ctypes.c_int64())
    answer = struct("decision")(of(FOUND)), taken, query
    update, finish = core.library.ssrvlad_tracker_update, core.library.ssrvlad_tracker_finish
    assert update(tracker, passed, 1, *answer) == number("NO_MEMORY")
    assert [update(tracker, passed, 1, *answer), finish(tracker, *answer)] == [-2, -2]
    assert last_error() == "memory was not enough for an earlier call"
    assert core.library.ssrvlad_tracker_save(tracker, None, 0) == -1
    core.library.ssrvlad_tracker_free(tracker)
    core.library.ssrvlad_map_free(town)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("rings", 0, "rings: expected 1 to 64, got 0"),
        ("power", np.nan, "power: expected 0.5 to 1, got nan"),
        ("anchor", 2, "anchor: expected 0 to 1, got 2"),
        ("harmonics", 115, "harmonics: expected 1 to 114, got 115"),
    ],
)
def test_a_refused_setting_is_named(name, value, reason, core):
    settings = settings_of(SSRVLADConfig())
    setattr(settings, name, value)
    assert core.library.ssrvlad_new_for(INTERFACE, settings) is None
    assert last_error() == reason


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("new", [struct("settings")()]),
        ("map_new", [struct("drives")()]),
        ("map_of", [struct("drives")(), struct("shortlist")()]),
        ("loops_new", [struct("loops_settings")(), struct("loops_channel")(), 1]),
    ],
)
def test_a_program_of_another_interface_is_refused(name, arguments, core):
    """Before its structs are read."""
    older = INTERFACE - 1
    assert getattr(core.library, f"ssrvlad_{name}_for")(older, *arguments) is None
    got = f"interface {INTERFACE}, the program is of {older}: compile it again"
    assert last_error() == f"the library ssrvlad has {got}"


def random_setting(rng, lowest, highest):
    """The bounds, powers of two, short decimals and others, down to 1e-12."""
    value = rng.choice(
        [
            *(lowest, highest, 2.0 ** -rng.integers(0, 60), rng.uniform(lowest, highest)),
            *(round(rng.uniform(), rng.integers(1, 6)), rng.uniform() * 10.0 ** -rng.integers(12)),
        ]
    )
    return float(np.clip(value, lowest, highest))


def random_config(seed):
    rng = np.random.default_rng(seed)
    fractions = {"opening": 0.5, "closing": 0.5, "hole_area": 1, "region_area": 1}
    return SSRVLADConfig(
        **{name: random_setting(rng, 0, highest) for name, highest in fractions.items()},
        **{name: random_setting(rng, 1e-12, 1) for name in ("radius", "inner_radius")},
        **{name: str(rng.choice(names)) for name, names in CHOICES.items()},
        spectral_weight=random_setting(rng, 0, 4),
        power=random_setting(rng, 0.5, 1),
        working_size=None if rng.integers(4) == 0 else int(rng.integers(1, 500)),
        **{name: int(rng.integers(8, 64)) for name in ("rings", "sectors", "harmonics")},
    )


def test_the_fingerprint_of_a_head_is_that_of_its_config(core):
    presets = [SSRVLADConfig.from_preset(preset) for preset in PRESETS]
    for config in (*presets, *map(random_config, range(60))):
        head = ctypes.c_void_p(core.library.ssrvlad_new_for(INTERFACE, settings_of(config)))
        fingerprint = ctypes.string_at(core.library.ssrvlad_fingerprint(head)).decode()
        core.library.ssrvlad_free(head)
        assert fingerprint == config.fingerprint, config


def test_the_library_has_no_other_names_than_its_own(core):
    """It would lend others its copy of the C++ library."""
    code, lines, errors = outcome("nm", "-D", "--defined-only", FOLDER / LIBRARY)
    assert code == 0, errors
    names = [line.split()[-1] for line in lines]
    assert names and not [name for name in names if not name.startswith("ssrvlad_")]


def test_wide_registers_are_used_by_the_kernels_of_their_processors_alone(core):
    """Elsewhere they would end a program on a processor that lacks them."""
    command = ("objdump", "--disassemble", "--demangle", "--no-show-raw-insn", FOLDER / LIBRARY)
    code, lines, errors = outcome(*command)
    assert code == 0, errors
    functions, name = {"ymm": set(), "zmm": set()}, ""
    for line in lines:
        name = line if line.endswith(">:") else name
        for register, names in functions.items():
            if f"%{register}" in line:
                names.add(name)
    assert not [name for name in functions["zmm"] if "Avx512" not in name]
    assert not [name for name in functions["ymm"] if "Avx512" not in name and "Avx2" not in name]
