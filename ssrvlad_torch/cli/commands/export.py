"""``ssrvlad export``."""

from __future__ import annotations

from pathlib import Path

from ..options import LabelsAs, Preset, option
from ..output import say


def export(
    *,
    output: Path = option(..., "ONNX file to write.", "--output", "-o"),
    labels_as: LabelsAs,
    given: str = option("labels", "What the file takes: labels or logits.", "--input"),
    dtype: str | None = option(None, "Of the labels: uint8, int32 or int64. Without it, uint8."),
    preset: Preset = "default",
    sweep: bool = option(
        False,
        "Describe each frame from several anchors, (B, S, D), for queries from a camera "
        "that is turned or moved aside.",
        "--sweep",
    ),
    form: str = option(
        "standard", "standard, or arithmetic: of any picture the same steps, for accelerators."
    ),
    size: str | None = option(
        None, "Rows and columns, HxW, of an arithmetic file that takes no others."
    ),
    batch: int | None = option(None, "Images of each call, with --size; 1 if not given.", min=1),
) -> None:
    """Write the head as one ONNX file that needs ONNX Runtime only: label ids, or class scores,
    to descriptors.

    Example: ssrvlad export -o head.onnx --labels-as cityscapes-trainids --input logits
    """
    from ...config import SSRVLADConfig
    from ...deployment.export import export_head
    from ...recognition.sweep import COLUMNS

    config = SSRVLADConfig.from_preset(preset, labels_as=labels_as)
    columns = COLUMNS if sweep else ()
    if batch and not size:
        raise ValueError(f"--batch {batch} is for a file of fixed size; expected --size as well")
    shape = (batch or 1, *_size(size)) if size else None
    export_head(config, output, given, dtype, columns, form, shape)
    say(f"{output}: {given} of {labels_as} to descriptors of fingerprint {config.fingerprint}")


def _size(text: str) -> tuple[int, int]:
    """Rows and columns of ``HxW``."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise ValueError(f"--size {text}: expected rows and columns, as in 512x1024")
    return int(height), int(width)
