import pytest
import torch
from drawings import SPACE
from exported import in_space

from ssrvlad_torch.cli import bench
from ssrvlad_torch.cli.bench import Timing, bench_this_machine, threads, time_in_turn
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity


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


class City(SyntheticCity):
    """In a label space whose heads other tests trace too, which takes long."""

    def traverse(self, *args, **kwargs):
        for frame in super().traverse(*args, **{**kwargs, "labels_as": "cityscapes-trainids"}):
            yield frame._replace(labels=in_space(frame.labels))


def test_the_table_has_a_row_for_every_way(core, monkeypatch):
    new = {"SIZE": (48, 64), "BATCH": 2, "LABELS_AS": SPACE, "SyntheticCity": City}
    for name, value in new.items():
        monkeypatch.setattr(bench, name, value)
    rows = bench_this_machine(repetitions=1)
    ways = ("torch", "native core", "ONNX Runtime")
    assert [(row["preset"], row["batch"], row["way"]) for row in rows] == [
        (preset, *rest)
        for preset in ("paper", "default")
        for rest in ((1, "reference"), *((1, way) for way in ways), *((2, way) for way in ways))
    ]
    for row in rows:
        assert 0 < row["min_ms"] <= row["median_ms"] <= row["max_ms"]
        assert (row["batch"] == 1) == ("times_faster" in row)
