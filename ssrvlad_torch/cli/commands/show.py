"""``ssrvlad show``."""

from pathlib import Path

from ...encoding.selection import NETWORK, FrameSelection
from ..options import Preset, argument, option
from ..output import note, say


def show(
    *,
    frame: Path = argument("A label map, or an image with --segmenter."),
    output: Path = option("Picture to write.", "--output", "-o", default=...),
    labels_as: str | None = option(
        "Label space of the ids: a name, a .yaml file, or auto (by the class names of the "
        "segmenter). Default: the one of the segmenter."
    ),
    segmenter: str | None = option(f"Segmentation network that labels images: {NETWORK}"),
    preset: Preset = "default",
) -> None:
    """Draw one frame: the image if --segmenter labels it, with what features see in it, its label
    map, the layers and their histograms (of boundaries with default, of skeletons with keypoints
    and centres with paper).

    Example: ssrvlad show maps/monday/000042.png -o frame.png --labels-as camvid-11
    """
    from ...datasets.image_files import read_image
    from ...datasets.label_files import LabelMap, read_label_map
    from ...descriptor import SSRVLAD
    from ...encoding.source import open_frames
    from ...files import require_picture, write_picture

    require_picture(output)
    selection = FrameSelection([str(frame)], labels_as, segmenter=segmenter)
    source = open_frames(selection, note=note)
    head = SSRVLAD.from_preset(preset, labels_as=source.labels_as)
    if len(source.files) != 1:
        raise ValueError(f"{frame}: expected one frame, got {len(source.files)}")
    file, network = source.files[0], source.segmenter
    picture = features = None
    try:
        if network is None:
            labels: LabelMap | ValueError = read_label_map(file, head.label_space)
        else:
            ((_, result),) = network.segmented([file], features=not network.problem_of_features)
            if isinstance(result, ValueError):
                raise result
            picture, labels, features = read_image(file), *result
        if isinstance(labels, ValueError):
            raise labels
        view = head.explain(labels[None])
    except ValueError as error:
        raise ValueError(f"{file.location}: {error}") from error
    write_picture(view.show(0, file.frame, picture, features), output)
    say(output)
