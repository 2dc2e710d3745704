from graphs import run
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment import geometry
from ssrvlad_torch.deployment.words import grid_of

CONFIG = SSRVLADConfig.from_preset("paper", closing=0.013, hole_area=0.00217, rings=4, radius=0.37)
SIZES = {"height": st.integers(1, 3000), "width": st.integers(1, 3000)}


def lengths(graph, height, width):
    grid = grid_of(graph.full([], 1, "int32"), height, width)
    found = geometry.lengths(graph, CONFIG, grid)
    assert found.opening == 0, "a radius that is always zero costs nothing"
    return found[1:]


def expected_lengths(height, width):
    return [
        CONFIG.radius_pixels(CONFIG.closing, height, width),
        CONFIG.area_pixels(CONFIG.hole_area, height, width),
        CONFIG.area_pixels(CONFIG.region_area, height, width),
        list(CONFIG.ring_limits(height, width)),
    ]


@given(**SIZES)
@example(height=1 << 14, width=1 << 14)
@example(height=1, width=1 << 15)
@example(height=1000, width=1000)
def test_lengths_and_areas_are_the_configs(height, width):
    found = [x.tolist() for x in run(lengths, height, width)]
    assert found == expected_lengths(height, width)
