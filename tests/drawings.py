"""Tiny hand-drawn masks and label maps, extreme ones and real ones, on which every path must give
what the reference gives."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from PIL import Image
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, reference

SPACE = "camvid-11"
SKY, BUILDING, POLE, ROAD, PAVEMENT, TREE = 0, 1, 2, 3, 4, 5
SIGN, FENCE, CAR, VOID = 6, 7, 8, 11

DOT = """
.....
..#..
.....
"""

CROSS = """
...#...
...#...
...#...
#######
...#...
...#...
...#...
"""

CROWDED_CROSSING = """
#.....#
.#...#.
..#.#..
...##..
..#.#..
.#...#.
#.....#
"""

RING = """
.......
.#####.
.#...#.
.#...#.
.#####.
.......
"""

FULL = """
######
######
######
######
"""

HOLES = """
##########
#..######.
#..##.###.
######.###
##########
##########
#.########
"""

SPECKS = """
#........#
..........
..##......
..##...#..
......#...
...#......
##.....###
##.....###
"""

SPIRAL = """
###########
..........#
#########.#
#.......#.#
#.#####.#.#
#.#...#.#.#
#.#.###.#.#
#.#.....#.#
#.#######.#
#.........#
###########
"""

MASKS = {
    name: drawing
    for name, drawing in globals().items()
    if name.isupper() and isinstance(drawing, str) and "\n" in drawing
}


def mask(drawing: str) -> npt.NDArray[np.bool_]:
    """``(H, W)`` bool, true at ``#``."""
    return np.array([[cell == "#" for cell in row] for row in drawing.split()])


def pack(layers: npt.NDArray[np.bool_]) -> Tensor:
    """``(B, 8, H, W)`` layers -> ``(B, H, W)`` uint8 bit-planes."""
    return torch.from_numpy(np.packbits(layers, axis=1, bitorder="little")[:, 0])


def random_planes(seed: int = 0, shape: tuple[int, int, int] = (3, 13, 17)) -> Tensor:
    """Bit-planes of which half of the pixels of every layer are on."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)


def every_neighbourhood() -> Tensor:
    """``(64, 3, 3)`` bit-planes, whose layers are all 512 patterns of 3 x 3 pixels."""
    patterns = np.arange(512)[:, None] >> np.arange(9) & 1
    return pack(patterns.reshape(64, 8, 3, 3).astype(bool))


def blobs(seed: int, height: int, width: int, grain: float) -> npt.NDArray[np.uint8]:
    """A random label map in ``SPACE``: random ids, enlarged to grains of that many pixels."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 12, (int(height / grain) + 2, int(width / grain) + 2), dtype=np.uint8)
    wobble_y, wobble_x = rng.uniform(0, 1, (2, height, width))
    y = (np.arange(height)[:, None] + wobble_y) / grain
    x = (np.arange(width)[None, :] + wobble_x) / grain
    return ids[y.astype(int), x.astype(int)]


def one_hot(labels: npt.NDArray[np.uint8], classes: int = 12) -> Tensor:
    """``(1, classes, H, W)`` float32 class scores of a label map."""
    hot = torch.eye(classes)[torch.from_numpy(labels).long()]
    return hot.permute(2, 0, 1)[None].contiguous()


REAL = Path(__file__).parents[2] / "shared" / "data"
CAMVID = REAL / "camvid"

needs_camvid = pytest.mark.skipif(
    not CAMVID.is_dir(), reason="the CamVid labels of ../shared/data are not on this machine"
)
needs_real = pytest.mark.skipif(
    not (REAL / "networks").is_dir(), reason="the networks of ../shared/data are not here"
)


def degenerate() -> dict[str, npt.NDArray[np.uint8]]:
    """Extreme label maps."""
    checkerboard = np.indices((17, 23)).sum(0) % 2
    return {
        "one pixel": np.full((1, 1), ROAD, np.uint8),
        "one row": np.repeat(np.array([[ROAD, TREE, VOID]], np.uint8), 5, axis=1),
        "one column": np.repeat(np.array([[ROAD], [TREE]], np.uint8), 9, axis=0),
        "all void": np.full((12, 9), VOID, np.uint8),
        "all dynamic": np.full((9, 12), CAR, np.uint8),
        "all one class": np.full((31, 44), ROAD, np.uint8),
        "checkerboard": np.where(checkerboard, ROAD, TREE).astype(np.uint8),
        "checkerboard and void": np.where(checkerboard, ROAD, VOID).astype(np.uint8),
    }


def hand_drawn() -> dict[str, npt.NDArray[np.uint8]]:
    """Each drawing as the road layer, on a ground of trees."""
    return {
        name: np.where(mask(drawing), ROAD, TREE).astype(np.uint8)
        for name, drawing in MASKS.items()
    }


def camvid_labels(every: int) -> list[npt.NDArray[np.uint8]]:
    """Hand-made labels of both CamVid sequences, one frame in ``every``."""
    files = sorted(CAMVID.glob("*/labels/*.png"))
    return [np.asarray(Image.open(file)) for file in files[::every]]


def assert_equals_reference(labels: npt.NDArray[np.integer], config: SSRVLADConfig) -> None:
    """The module and the reference agree on one label map at every step."""
    view = SSRVLAD(config).explain(torch.tensor(labels)[None])
    layers = reference.layers_of(labels, config)
    traces = [reference.trace(layer, config) for layer in layers]
    for k, trace in enumerate(traces):
        for name, expected, got in (
            ("layer", trace.layer, view.layers),
            ("clean layer", trace.clean, view.clean_layers),
            ("skeleton", trace.skeleton, view.skeleton),
            ("end points", trace.end_points, view.end_points),
            ("intersections", trace.intersections, view.intersections),
        ):
            np.testing.assert_array_equal(got[0, k].numpy(), expected, f"{name} of layer {k}")
        assert tuple(view.centres[0, k].tolist()) == (trace.centre or (-1, -1)), f"centre {k}"
    expected = (
        reference.harmonics(layers, config)
        if config.aggregation == "harmonics"
        else reference.residuals(traces, config)
    )
    for name, histogram in expected.histograms.items():
        got = getattr(view.histograms, name)[0].numpy()
        if name == "bins":  # roots: of a share near 0, a root shows the rounding of its table
            np.testing.assert_allclose(got**2, histogram**2, rtol=1e-12, atol=1e-15, err_msg=name)
        else:
            np.testing.assert_array_equal(got, histogram, name)
    np.testing.assert_allclose(view.descriptor[0].numpy(), expected.descriptor, rtol=0, atol=1e-6)
