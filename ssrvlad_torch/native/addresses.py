"""Where an array is in memory: the one way by which the core gets one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def address(array: Any, shape: Sequence[int], *dtypes: str) -> int | None:
    """The address of an array of NumPy or a tensor of torch, which the core reads or fills;
    ``None`` of ``None``.

    Args:
        array: in the memory of the CPU, C-contiguous.
        shape: the shape that the core takes it for.
        dtypes: names of those that the core takes it for, such as ``"float32"``.

    Raises:
        ValueError: the array is of another kind.
    """
    if array is None:
        return None
    of_torch = hasattr(array, "data_ptr")
    contiguous = array.is_contiguous() if of_torch else array.flags.c_contiguous
    dtype, device = str(array.dtype).removeprefix("torch."), str(getattr(array, "device", "cpu"))
    size = tuple(array.shape)
    if dtype not in dtypes or size != tuple(shape) or device != "cpu" or not contiguous:
        order = "" if contiguous else ", not contiguous"
        raise ValueError(
            f"expected an array {tuple(shape)} of {' or '.join(dtypes)} on cpu, got {size} of "
            f"{dtype} on {device}{order}"
        )
    return int(array.data_ptr() if of_torch else array.ctypes.data)
