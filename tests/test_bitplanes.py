import torch
from drawings import MASKS, RING, mask, planes

from ssrvlad_torch.stages import bitplanes


def random_planes(seed: int = 0, shape: tuple[int, int, int] = (3, 13, 17)) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)


def test_pack_and_unpack_are_inverse():
    some = random_planes()
    layers = bitplanes.unpack(some)
    assert layers.shape == (3, 8, 13, 17)
    assert layers.dtype == torch.bool
    assert torch.equal(bitplanes.pack(layers), some)


def test_neighbours_are_clockwise_from_north_and_zero_outside():
    some = random_planes()
    padded = torch.nn.functional.pad(some, (1, 1, 1, 1))
    offsets = [(-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]
    for plane, (dy, dx) in zip(bitplanes.neighbours(some), offsets, strict=True):
        assert torch.equal(plane, padded[:, 1 + dy : 14 + dy, 1 + dx : 18 + dx])


def test_two_or_more():
    some = [random_planes(seed) for seed in range(4)]
    expected = sum(bitplanes.unpack(plane).int() for plane in some) >= 2
    assert torch.equal(bitplanes.unpack(bitplanes.two_or_more(some)), expected)


def test_points_are_the_set_pixels_by_layer_then_image_then_raster_order():
    some = random_planes()
    group, y, x = bitplanes.points(some)
    layer, image, expected_y, expected_x = (
        bitplanes.unpack(some).transpose(0, 1).nonzero(as_tuple=True)
    )
    assert torch.equal(group, layer * 3 + image)
    assert torch.equal(y, expected_y)
    assert torch.equal(x, expected_x)


def test_count_points():
    some = random_planes()
    counts = bitplanes.count_points(bitplanes.points(some), 3)
    assert torch.equal(counts, bitplanes.unpack(some).sum((2, 3)))


def test_runs_by_hand():
    group, y, first, last = bitplanes.runs(planes(mask(RING)))
    assert group.tolist() == [0] * 6
    assert list(zip(y.tolist(), first.tolist(), last.tolist(), strict=True)) == [
        (1, 1, 5),
        (2, 1, 1),
        (2, 5, 5),
        (3, 1, 1),
        (3, 5, 5),
        (4, 1, 5),
    ]


def test_painting_all_runs_gives_the_planes_back():
    for some in (random_planes(1), *(planes(mask(drawing)) for drawing in MASKS.values())):
        assert torch.equal(bitplanes.paint(bitplanes.runs(some), some.shape), some)


def test_not_contiguous_planes():
    some = random_planes().transpose(1, 2)
    assert torch.equal(bitplanes.paint(bitplanes.runs(some), some.shape), some)
