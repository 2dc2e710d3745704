"""``ssrvlad export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..options import LabelsAs, Preset
from ..output import say


def export(
    output: Annotated[Path, typer.Option("--output", "-o", help="ONNX file to write.")],
    labels_as: LabelsAs,
    given: Annotated[
        str, typer.Option("--input", help="What the file takes: labels or logits.")
    ] = "labels",
    dtype: Annotated[str, typer.Option(help="Of the labels: uint8 or int64.")] = "uint8",
    preset: Preset = "default",
    sweep: Annotated[
        bool,
        typer.Option(
            "--sweep",
            help="Describe each frame from several anchors, (B, S, D), for queries from a camera "
            "that is turned or moved aside.",
        ),
    ] = False,
) -> None:
    """Write the head as one ONNX file that needs ONNX Runtime only: label ids, or class scores,
    to descriptors.

    Example: ssrvlad export -o head.onnx --labels-as cityscapes-trainids --input logits
    """
    from ...config import SSRVLADConfig
    from ...deployment.export import export_head
    from ...recognition.sweep import COLUMNS

    config = SSRVLADConfig.from_preset(preset, labels_as=labels_as)
    export_head(config, output, given, dtype, COLUMNS if sweep else ())
    say(f"{output}: {given} of {labels_as} to descriptors of fingerprint {config.fingerprint}")
