"""The trained network as an ONNX file, for ``ssrvlad fuse`` and ``--segmenter``."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn


def write_onnx(network: nn.Module, size: tuple[int, int], path: Path) -> None:
    """Writes a network that takes ``(B, 3, h, w)`` images of one size, any number of them.

    Raises:
        ImportError: the extra ``onnx`` is not installed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        network.eval(),
        (torch.zeros(2, 3, *size),),
        path,
        input_names=["images"],
        output_names=["scores"],
        dynamic_shapes={"images": {0: torch.export.Dim("images")}},
        dynamo=True,
        verbose=False,
        external_data=False,
    )
