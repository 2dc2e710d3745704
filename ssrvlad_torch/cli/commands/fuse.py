"""``ssrvlad fuse``."""

from __future__ import annotations

from pathlib import Path

from ..options import Preset, argument, option
from ..output import say


def fuse(
    *,
    network: str = argument(
        "Network: FILE.onnx, FILE.yaml, hf:ORG/NAME[@REVISION], a folder, "
        "torchhub:REPO/MODEL or MODULE:NAME."
    ),
    path: Path = option(..., "ONNX file to write.", "-o"),
    labels_as: str = option(
        "auto", "Label space of its classes; auto takes the network's class names."
    ),
    classes: str | None = option(None, "FIRST:LAST, the channels to take, as 0:19."),
    preset: Preset = "default",
    split: Path | None = option(
        None,
        "Write the head to this file of its own; -o then takes pictures to label maps, so "
        "that the network can run on an accelerator and the head on the CPU.",
    ),
) -> None:
    """Join a segmentation network and the head in one ONNX file: pictures to descriptors, with
    all that is done to pictures in it.

    Example: ssrvlad fuse seg.yaml -o place.onnx --labels-as cityscapes-trainids
    """
    from ...config import SSRVLADConfig
    from ...deployment.fuse import fuse as join
    from ...segmentation.networks import channels
    from ...segmentation.segmenter import Segmenter

    segmenter = Segmenter.load(network, labels_as, classes=channels(classes))
    space = segmenter.label_space if labels_as == "auto" else labels_as
    config = SSRVLADConfig.from_preset(preset, labels_as=space)
    join(segmenter, config, path, split)
    written = f"{path} and {split}" if split else str(path)
    say(
        f"{written}: {network} as {segmenter.label_space.name} to descriptors of fingerprint "
        f"{config.fingerprint}"
    )
