import numpy as np
import pytest
import torch
from graphs import session

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment.trace import traced
from ssrvlad_torch.stages.lengths import lengths

CONFIG = SSRVLADConfig.from_preset("paper", opening=0.033333, closing=0.25, hole_area=0.123456)
HUGE = [(1, 1), (1, 40_000), (719, 1281), (6000, 4000), (10_007, 9973), (30_000, 30_000)]


class InPixels(torch.nn.Module):
    """The lengths of a grid, by the sizes of an empty tensor."""

    def forward(self, empty: torch.Tensor) -> tuple[torch.Tensor, ...]:
        *sizes, limits = lengths(CONFIG, *empty.shape[:2])
        return tuple(map(torch.as_tensor, (*sizes, *limits)))


@pytest.fixture
def in_graph():
    names = [f"n{number}" for number in range(4 + CONFIG.rings)]
    example = torch.zeros(5, 7, 0)
    model = traced(InPixels(), {"empty": (example, ["H", "W", 0])}, dict.fromkeys(names, ()))
    runner = session(model.SerializeToString())
    return lambda height, width: runner.run(names, {"empty": np.zeros((height, width, 0), "f4")})


def test_lengths_in_a_graph_are_those_of_the_config(in_graph):
    for size in (*HUGE, *np.random.default_rng(0).integers(1, 30_000, (300, 2)).tolist()):
        *sizes, limits = lengths(CONFIG, *size)
        found = in_graph(*size)
        assert [int(number) for number in found] == [*sizes, *limits]
        assert all(number.dtype == np.int32 for number in found)
