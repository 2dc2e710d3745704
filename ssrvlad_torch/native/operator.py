"""``torch.ops.ssrvlad.describe``, one operator for `torch.compile` and `torch.export`.

Other callers use the function `describe` directly: the first call of the operator makes torch
import its compiler, which takes as long as importing torch.
"""

import ctypes
import json
import weakref
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from ..config import CHOICES, SSRVLADConfig
from . import core, failure
from .addresses import address
from .headers import number, struct

_NATIVE_DTYPES = (torch.uint8, torch.int16, torch.int32, torch.int64)
_LABELS = tuple(str(dtype).removeprefix("torch.") for dtype in _NATIVE_DTYPES)


class UnknownIdError(ValueError):
    """A label map holds an id that is not in the table."""


def describe(labels: Tensor, table: Tensor, origin: int, settings: str) -> Tensor:
    """The descriptors ``(B, D)`` float32 of label maps ``(B, H, W)`` of any integer dtype; the
    images are shared among torch's threads. The table and its origin are from `category_table`, the
    settings are those of a config in JSON, without the label space. An id that is not in the table
    is an UnknownIdError, a size that the native core does not accept is a RuntimeError, short
    memory a MemoryError."""
    head = _Head(settings)
    if labels.dtype == torch.uint64:
        wide = labels.to(torch.int64)
        labels = torch.where(wide < 0, 1 << 40, wide)  # beyond int64: in no label space
    elif labels.dtype not in _NATIVE_DTYPES:
        labels = labels.to(torch.int64)
    labels, table = labels.contiguous(), table.contiguous()
    # whatever torch's default dtype and device are
    descriptors = torch.empty((len(labels), head.length), dtype=torch.float32, device="cpu")
    ids = address(labels, labels.shape, *_LABELS)
    status = head.library.ssrvlad_describe(
        head.handle,
        struct("labels")(ids, labels.element_size(), *labels.shape),
        struct("table")(address(table, (len(table),), "uint8"), len(table), origin),
        torch.get_num_threads(),
        descriptors.data_ptr(),
    )
    if status > 0:
        table_ids = (table != table[-1]).nonzero()[:, 0] - origin
        first = int(labels[~torch.isin(labels, table_ids)].min())
        raise UnknownIdError(
            f"label id {first} is not in the label space; {status} pixels have such ids"
        )
    if status < 0:
        raise failure(RuntimeError, f"label maps {tuple(labels.shape)}")
    return descriptors


operator = torch.library.custom_op(
    "ssrvlad::describe", describe, mutates_args=(), device_types="cpu"
)


@operator.register_fake
def _(labels: Tensor, table: Tensor, origin: int, settings: str) -> Tensor:
    length = SSRVLADConfig.from_dict(json.loads(settings)).length
    return labels.new_empty((labels.shape[0], length), dtype=torch.float32)


def settings_of(config: SSRVLADConfig) -> Any:
    """A config as ``ssrvlad_settings``."""
    structure = struct("settings")
    values = {name: getattr(config, name) for name, *_ in structure._fields_}
    values.update({name: choices.index(values[name]) for name, choices in CHOICES.items()})
    return structure(**{**values, "working_size": config.working_size or 0})


@lru_cache(maxsize=16)
class _Head:
    """A head of the library, freed together with this object; one for the same settings."""

    def __init__(self, settings: str) -> None:
        config, library = SSRVLADConfig.from_dict(json.loads(settings)), core().library
        if library is None:
            raise RuntimeError("the native core was not built")
        self.library, self.length = library, config.length
        self.handle = library.ssrvlad_new_for(number("INTERFACE"), settings_of(config))
        if not self.handle:
            raise failure(RuntimeError)
        weakref.finalize(self, library.ssrvlad_free, ctypes.c_void_p(self.handle))
