import pytest
import torch

from ssrvlad_torch.stages.layers import UNKNOWN, categorise, category_table, refuse_unknown, split
from ssrvlad_torch.taxonomy import NO_LAYER, label_space, label_space_names


@pytest.mark.parametrize("name", label_space_names())
def test_every_id_goes_to_its_category(name):
    space = label_space(name)
    labels = torch.tensor([[[label.id for label in space.classes]]])
    categories = categorise(labels, *category_table(space))
    assert categories.tolist() == [[[label.category_index for label in space.classes]]]


@pytest.mark.parametrize("bits", [8, 16, 32, 64])
@pytest.mark.parametrize("kind", ["int", "uint"])
def test_categories_are_uint8_for_any_integer_dtype(kind, bits):
    space = label_space("camvid-11")
    labels = torch.tensor([[[3, 11, 7]]]).to(getattr(torch, f"{kind}{bits}"))
    categories = categorise(labels, *category_table(space))
    assert categories.dtype == torch.uint8
    assert categories.tolist() == [[[0, NO_LAYER, 2]]]


@pytest.mark.parametrize(
    ("unknown", "dtype"),
    [
        *((number, torch.int64) for number in (-1, 12, 255, -(2**40), 2**62)),
        *((2**32 - 1, torch.uint32), (2**64 - 1, torch.uint64), (2**32 + 3, torch.uint64)),
    ],
)
def test_an_unknown_id_is_named_with_its_count_and_the_space(unknown, dtype):
    """Large unsigned ids do not wrap into known ones."""
    space = label_space("camvid-11")
    labels = torch.tensor([[[3, unknown], [unknown, 5]]], dtype=dtype)
    categories = categorise(labels, *category_table(space))
    assert (categories == UNKNOWN).tolist() == [[[False, True], [True, False]]]
    named = rf"label id {unknown} \(2 pixels\) is not in label space camvid-11; expected 0 to 11"
    with pytest.raises(ValueError, match=named):
        refuse_unknown(labels, space)
    with pytest.raises(ValueError, match=r"label id 20 \(1 pixel\) is not .*, like 2 more"):
        refuse_unknown(torch.tensor([[[20, 21, 40, 21]]]), space)


def test_split_sets_one_bit_a_pixel():
    categories = torch.tensor([[[0, 1, 2, 3, 4, 5, 6, 7, NO_LAYER]]], dtype=torch.uint8)
    assert split(categories).tolist() == [[[1, 2, 4, 8, 16, 32, 64, 128, 0]]]
