"""What pages/benchmark.py rests on: timing in turn, and the ways to describe one image."""

import benchmark
import numpy as np
import pytest
import torch
from _timing import Timing, threads, time_in_turn
from drawings import SPACE, blobs

from ssrvlad_torch import SSRVLAD, SSRVLADConfig


def test_ways_are_timed_in_turn():
    calls = []
    ways = {name: lambda name=name: calls.append(name) for name in ("a", "b")}
    timings = time_in_turn(ways, repetitions=3)
    assert calls == ["a", "b"] * 4  # the first pair is the warm-up
    assert [len(timing.seconds) for timing in timings.values()] == [3, 3]
    calls.clear()
    time_in_turn(ways, repetitions=1, warm_up=False)
    assert calls == ["a", "b"]


def test_ratios_are_taken_repetition_by_repetition():
    slow, fast = Timing((1.0, 8.0, 3.0)), Timing((0.5, 1.0, 1.0))
    assert fast.times_faster_than(slow) == {"median": 3.0, "min": 2.0, "max": 8.0}
    assert slow.milliseconds == {"median": 3000.0, "min": 1000.0, "max": 8000.0}


def test_threads_are_put_back():
    before = torch.get_num_threads()
    with pytest.raises(RuntimeError, match="on purpose"), threads(before + 1):
        assert torch.get_num_threads() == before + 1
        raise RuntimeError("on purpose")
    assert torch.get_num_threads() == before


class DrawnMaps:
    def config(self, preset):
        return SSRVLADConfig.from_preset(preset, labels_as=SPACE)

    def batch(self, size, count):
        return torch.from_numpy(np.stack([blobs(seed, *size, 8.0) for seed in range(count)]))


def test_the_table_has_a_row_for_every_way(core, monkeypatch):
    monkeypatch.setattr(benchmark, "onnx_head", SSRVLAD)  # an export takes minutes
    monkeypatch.setattr(benchmark, "SIZES", [(240, 320)])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    rows = list(benchmark.size_table(DrawnMaps(), repetitions=1))[2:]
    ways = ("reference", "module, torch", "module, native core", "ONNX Runtime")
    cells = [row.split(" | ") for row in rows]
    starts = [[f"| {preset}", "240 x 320", way] for preset in ("paper", "default") for way in ways]
    assert [row[:3] for row in cells] == starts
    assert all(float(row[3].split()[0]) > 0 for row in cells)
