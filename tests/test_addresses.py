"""Where an array is in memory: only what the core takes has an address."""

import numpy as np
import pytest
import torch
from helpers import refuses

from ssrvlad_torch.native.addresses import address


@pytest.mark.parametrize("make", [np.zeros, torch.zeros])
def test_the_address_is_that_of_the_first_number(make):
    rows = make((4, 3), dtype=np.float32 if make is np.zeros else torch.float32)
    first = rows.ctypes.data if make is np.zeros else rows.data_ptr()
    assert address(rows, (4, 3), "float32") == first
    assert address(rows[2:], [2, 3], "uint8", "float32") == first + 2 * 3 * 4


@pytest.mark.parametrize(
    ("array", "got"),
    [
        (torch.zeros(4, 3, dtype=torch.float64), r"\(4, 3\) of float64 on cpu"),
        (torch.zeros(4, 3, dtype=torch.bfloat16), r"\(4, 3\) of bfloat16 on cpu"),
        (torch.zeros(4, 3, device="meta"), r"\(4, 3\) of float32 on meta"),
        (torch.zeros(3, 4).T, r"\(4, 3\) of float32 on cpu, not contiguous"),
        (torch.zeros(3, 4), r"\(3, 4\) of float32 on cpu"),
        (np.zeros((4, 3)), r"\(4, 3\) of float64 on cpu"),
        (np.zeros((4, 3), ">f4"), r"\(4, 3\) of >f4 on cpu"),
        (np.zeros((4, 6), np.float32)[:, ::2], r"\(4, 3\) of float32 on cpu, not contiguous"),
    ],
)
def test_an_array_that_the_core_does_not_take_is_refused(array, got):
    message = rf"expected an array \(4, 3\) of float32 on cpu, got {got}"
    refuses(message, address, array, (4, 3), "float32")
