"""``ssrvlad fuse``."""

from pathlib import Path

from ...encoding.selection import NETWORK
from ..options import Preset, argument, option
from ..output import note, progress_bar, say


def fuse(
    *,
    network: str = argument(f"Segmentation network: {NETWORK}"),
    output: Path = option("ONNX file to write.", "--output", "-o", default=...),
    labels_as: str = option(
        "Label space of its classes: a name, a .yaml file, or auto (by the network's class names).",
        default="auto",
    ),
    preset: Preset = "default",
    split: Path | None = option(
        "Write the head to this second file. The first file then gives label maps: it can run on "
        "an accelerator and the head on the CPU."
    ),
    features: bool | None = option(
        "Give the features of the network too, or do not. Default: if it has some.",
        "--features/--no-features",
    ),
) -> None:
    """Join a segmentation network and the head in one ONNX file, from pictures to descriptors and
    features. The file prepares the pictures (size, normalisation) as the network requires.

    Example: ssrvlad fuse seg.yaml -o place.onnx --labels-as cityscapes-trainids
    """
    from ...config import SSRVLADConfig
    from ...deployment.fuse import STEPS
    from ...deployment.fuse import fuse as join
    from ...files import check_output
    from ...segmentation.networks import open_network
    from ...segmentation.segmenter import Segmenter

    for file in filter(None, (output, split)):
        check_output(file)
    named = open_network(network)
    if named.assumption:
        note(named.assumption)
    segmenter = Segmenter.load(named, labels_as)
    space = segmenter.label_space if labels_as == "auto" else labels_as
    config = SSRVLADConfig.from_preset(preset, labels_as=space)
    with progress_bar("joining", STEPS) as bar:
        signs = join(segmenter, config, output, split, features, bar.advance).features
    written = f"{output} and {split}" if split else str(output)
    say(
        f"{written}: {network} as {segmenter.label_space.name} to descriptors of fingerprint "
        f"{config.fingerprint}" + (f" and features: {signs}" if signs else ", without features")
    )
