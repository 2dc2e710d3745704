"""``ssrvlad show``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..options import LabelsAs, Preset


def show(
    labels: Annotated[Path, typer.Argument(help="A label map.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write.")],
    labels_as: LabelsAs,
    preset: Preset = "default",
) -> None:
    """Picture what the method sees in one frame: layers, skeletons, keypoints, centres,
    histograms.

    Example: ssrvlad show maps/monday/000042.png -o frame.png --labels-as camvid-11
    """
    from ...datasets.label_files import find_label_files, read_label_map
    from ...descriptor import SSRVLAD
    from ..show import draw

    head = SSRVLAD.from_preset(preset, labels_as=labels_as)
    file = find_label_files([str(labels)])[0]
    draw(read_label_map(file, head.label_space), head, output, title=file.frame)
    print(output)
