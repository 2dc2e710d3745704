"""Tiny hand-drawn masks, label maps and how to read them; shared by the tests."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

SPACE = "camvid-11"
SKY, BUILDING, POLE, ROAD, PAVEMENT, TREE = 0, 1, 2, 3, 4, 5
SIGN, FENCE, CAR, VOID = 6, 7, 8, 11

EMPTY = """
.....
.....
"""

DOT = """
.....
..#..
.....
"""

LINE = """
.......
.#####.
.......
"""

DIAGONAL = """
#....
.#...
..#..
...#.
....#
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

TEE = """
.........
.#######.
....#....
....#....
....#....
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

BLOCK = """
........
.######.
.######.
.######.
.######.
........
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


def planes(*masks: npt.NDArray[np.bool_]) -> Tensor:
    """``(1, H, W)`` bit-planes with the given masks of one size as layers 0, 1, ..."""
    layers = np.zeros((1, 8, *masks[0].shape), bool)
    layers[0, : len(masks)] = masks
    return pack(layers)


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
