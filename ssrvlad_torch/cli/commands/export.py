"""``ssrvlad export``."""

from pathlib import Path

from ..options import Preset, option, switch
from ..output import say


def export(
    *,
    output: Path = option("ONNX file to write.", "--output", "-o", default=...),
    labels_as: str = option("Label space of the ids: a name or a .yaml file.", default=...),
    input: str = option("Input of the file: labels or logits.", "--input", default="labels"),
    dtype: str | None = option("Type of the labels: uint8, int32 or int64. Default: uint8."),
    preset: Preset = "default",
    sweep: bool = switch(
        "--sweep",
        "Describe each frame from several anchors, (B, S, D), for queries of a camera that is "
        "turned or moved aside.",
    ),
    size: str | None = option("Fixed rows and columns, HxW, such as 512x1024. Default: any size."),
    batch: int | None = option(
        "With --size: fixed number of frames of each call. Default: 1.", min=1
    ),
) -> None:
    """Write the head as one ONNX file, from label ids or class scores to descriptors. It needs
    ONNX Runtime only.

    Example: ssrvlad export -o head.onnx --labels-as cityscapes-trainids --input logits
    """
    from ...config import SSRVLADConfig
    from ...deployment.export import export_head
    from ...recognition.sweep import COLUMNS

    config = SSRVLADConfig.from_preset(preset, labels_as=labels_as)
    columns = COLUMNS if sweep else ()
    if batch and not size:
        raise ValueError(f"--batch {batch} needs --size")
    shape = (batch or 1, *_size(size)) if size else None
    export_head(config, output, input, dtype, columns, shape)
    say(f"{output}: {input} of {labels_as} to descriptors of fingerprint {config.fingerprint}")


def _size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise ValueError(f"--size {text}: expected rows and columns, such as 512x1024")
    return int(height), int(width)
