"""``ssrvlad fuse``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..options import LabelsAs, Preset


def fuse(
    network: Annotated[Path, typer.Argument(help="ONNX file of a segmentation network.")],
    path: Annotated[Path, typer.Option("-o", help="ONNX file to write.")],
    labels_as: LabelsAs,
    output: Annotated[
        str | None,
        typer.Option(help="Output of the network to take, if several could be labels."),
    ] = None,
    preset: Preset = "default",
) -> None:
    """Join a segmentation network and the head in one ONNX file: images to descriptors.

    Example: ssrvlad fuse seg.onnx -o place.onnx --labels-as cityscapes-trainids
    """
    from ...config import SSRVLADConfig
    from ...deployment.fuse import fuse as join

    config = SSRVLADConfig.from_preset(preset, labels_as=labels_as)
    fused = join(network, config, path, output)
    print(
        f"{path}: output {fused.output} of {fused.name} as {labels_as} to descriptors of "
        f"fingerprint {config.fingerprint}"
    )
