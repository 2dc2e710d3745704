"""Temporal sum: the descriptors of reference frames summed over their neighbours (Eq. 3)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from .matching import Vectors

_BLOCK = 1 << 12


def temporal_sum(
    descriptors: Vectors, sequences: Sequence[str], reach: int, out: Tensor | None = None
) -> Tensor:
    """Descriptors ``(R, D)`` float of reference frames, in the order of their ``sequences``, summed
    over their neighbours and normalised (Eq. 3): ``(R, D)`` float32 of length 1, or zero. Frame i
    becomes the sum of frames i - t to i + t of its own sequence, t being the ``reach``, clipped at
    the ends. An empty frame, whose own descriptor is zero, stays zero. ``out`` is written into, and
    may be the descriptors. Another number of sequences, and a negative reach, are a ValueError."""
    single = torch.as_tensor(descriptors).float()
    if len(sequences) != len(single):
        raise ValueError(
            f"expected a sequence for each of {len(single)} frames, got {len(sequences)}"
        )
    if reach < 0:
        raise ValueError(f"the temporal reach must be 0 or more frames, got {reach}")
    number = {sequence: place for place, sequence in enumerate(dict.fromkeys(sequences))}
    drive = torch.tensor([number[sequence] for sequence in sequences], dtype=torch.int64)
    reach = min(reach, max(0, len(single) - 1))
    out = torch.empty_like(single) if out is None else out
    before = single[:0]
    for first in range(0, len(single), _BLOCK):
        last = min(first + _BLOCK, len(single))
        around = torch.cat((before, single[first : last + reach]))
        start = first - len(before)
        before = around[: last - start][-reach:].clone() if reach else single[:0]
        drives = drive[start : start + len(around)].to(around.device)
        # Eq. 3 over the block and the frames around it
        whole = torch.zeros_like(around)
        reached = min(reach, len(around) - 1)
        for offset in range(-reached, reached + 1):
            here = slice(max(0, -offset), len(around) - max(0, offset))
            there = slice(max(0, offset), len(around) - max(0, -offset))
            whole[here] += around[there] * (drives[here] == drives[there])[:, None]
        whole = F.normalize(whole * around.any(dim=1, keepdim=True), dim=1)
        out[first:last] = whole[first - start : last - start]
    return out
