"""``ssrvlad show``."""

from __future__ import annotations

from pathlib import Path

from ..options import Preset, argument, option
from ..output import say


def show(
    *,
    frame: Path = argument("A label map, or an image with --segmenter."),
    output: Path = option(..., "Picture to write.", "--output", "-o"),
    labels_as: str | None = option(None, "Label space of the ids: a name or a .yaml file."),
    segmenter: str | None = option(None, "Network that labels the image; see ssrvlad encode."),
    classes: str | None = option(None, "FIRST:LAST, channels of the network that are taken."),
    preset: Preset = "default",
) -> None:
    """Picture what the method sees in one frame: layers, boundaries and their histograms; with
    paper, layers, skeletons, keypoints, centres and histograms.

    Example: ssrvlad show maps/monday/000042.png -o frame.png --labels-as camvid-11
    """
    from ...datasets.image_files import find_image_files
    from ...datasets.label_files import LabelMap, find_label_files, read_label_map
    from ...descriptor import SSRVLAD
    from ...picture import require_picture, write_picture
    from ...segmentation.networks import AUTO, channels
    from ...segmentation.segmenter import Segmenter

    require_picture(output)
    if segmenter is None:
        if labels_as is None:
            raise ValueError("Missing option '--labels-as', or '--segmenter' for an image")
        head = SSRVLAD.from_preset(preset, labels_as=labels_as)
        file = find_label_files([str(frame)])[0]
    else:
        network = Segmenter.load(segmenter, labels_as or AUTO, classes=channels(classes))
        head = SSRVLAD.from_preset(preset, labels_as=network.label_space)
        file = find_image_files([str(frame)])[0]
    try:
        if segmenter is None:
            labels: LabelMap | ValueError = read_label_map(file, head.label_space)
        else:
            ((_, labels),) = network.label_maps([file])
        if isinstance(labels, ValueError):
            raise labels
        view = head.explain(labels[None])
    except ValueError as error:
        raise ValueError(f"{file.location}: {error}") from error
    write_picture(view.show(title=file.frame), output)
    say(output)
