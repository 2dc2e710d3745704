"""Times several implementations in turn, in one process, with a fixed number of threads."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from ssrvlad_torch.config import SSRVLADConfig
from ssrvlad_torch.deployment.export import head_model
from ssrvlad_torch.descriptor import SSRVLAD
from ssrvlad_torch.native import core
from ssrvlad_torch.segmentation.onnx_files import open_session


@dataclass(frozen=True)
class Timing:
    """Seconds of the repetitions of one implementation."""

    seconds: tuple[float, ...]

    @property
    def milliseconds(self) -> dict[str, float]:
        """``median``, ``min`` and ``max``."""
        ordered = sorted(1e3 * second for second in self.seconds)
        return {"median": median(ordered), "min": ordered[0], "max": ordered[-1]}

    def times_faster_than(self, other: Timing) -> dict[str, float]:
        """Ratios to another timing, repetition by repetition: ``median``, ``min`` and ``max``."""
        ratios = sorted(slow / fast for fast, slow in zip(self.seconds, other.seconds, strict=True))
        return {"median": median(ratios), "min": ratios[0], "max": ratios[-1]}


def time_in_turn(
    ways: Mapping[str, Callable[[], object]], repetitions: int, warm_up: bool = True
) -> dict[str, Timing]:
    """Times each function once, then each once again, and so on, so that a slow moment affects all
    of them. The warm-up calls each once before, so that compilation and first allocations do not
    count."""
    if warm_up:
        for way in ways.values():
            way()
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repetitions):
        for name, way in ways.items():
            begin = time.perf_counter()
            way()
            seconds[name].append(time.perf_counter() - begin)
    return {name: Timing(tuple(durations)) for name, durations in seconds.items()}


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Sets the number of threads of torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def heads(config: SSRVLADConfig) -> dict[str, SSRVLAD]:
    """The head on torch alone, and, if it is built, on the native core."""
    by_torch = SSRVLAD(config)
    by_torch.native = False
    return {"torch": by_torch, **({"native core": SSRVLAD(config)} if core().library else {})}


def onnx_head(config: SSRVLADConfig) -> Callable[[Tensor], Tensor]:
    """The exported head in ONNX Runtime, on one thread."""
    session = open_session(head_model(config).SerializeToString(), "the head", threads=1)

    def describe(labels: Tensor) -> Tensor:
        (descriptor,) = session.run(["descriptor"], {"labels": labels.numpy()})
        return torch.from_numpy(descriptor)

    return describe
