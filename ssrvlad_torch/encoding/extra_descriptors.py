"""Extra descriptors: of a frame's picture, for `recognition.fusion`."""

from collections.abc import Sequence

from ..baselines.hog import HOG
from ..database.metadata import ExtraDescriptor
from ..segmentation.features import NAME as FEATURES
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace

NONE = "none"


def extra_descriptors(
    names: Sequence[str] | None, segmenter: Segmenter | None
) -> list[ExtraDescriptor]:
    """The extra descriptors with these names: ``features``, of the network that labels the
    pictures; ``hog``; or ``none`` alone. Without names both, or HOG alone if the network has no
    features. An unknown name, no pictures for want of a segmenter, and features that the network
    does not have are a ValueError."""
    if isinstance(names, str):
        raise ValueError(f"expected a list of methods of pictures, got the text {names!r}")
    if names is None:
        if segmenter is None:
            return []
        names = [HOG.name] if segmenter.problem_of_features else [FEATURES, HOG.name]
    if NONE in names:
        if len(names) > 1:
            raise ValueError(f"expected {NONE} alone, got {', '.join(names)}")
        return []
    return [_of(name, segmenter) for name in dict.fromkeys(names)]


def check_segmenter(
    segmenter: Segmenter | None, space: LabelSpace, stored: Sequence[ExtraDescriptor]
) -> None:
    """Raises a ValueError unless a segmenter has the label space of a head, and its descriptors are
    those that are stored."""
    for each in stored:
        if segmenter is None:
            raise ValueError(
                f"{each.name} beside the descriptors describes pictures: expected images and a "
                "segmenter"
            )
        current = _of(each.name, segmenter)
        if current != each:
            raise ValueError(
                f"stored descriptors by {each.name} are of {each.fingerprint}, got "
                f"{current.fingerprint}: encode again, with the file that will be deployed, or use "
                "what made them; a module, its ONNX file and another size are different networks"
            )
    if segmenter and segmenter.label_space != space:
        raise ValueError(
            f"the segmenter gives labels of {segmenter.label_space.name}, the head reads "
            f"{space.name}"
        )


def extra_methods(stored: Sequence[ExtraDescriptor]) -> list[HOG]:
    """The methods that describe pictures themselves; features come with the label maps."""
    return [HOG() for each in stored if each.name == HOG.name]


def _of(name: str, segmenter: Segmenter | None) -> ExtraDescriptor:
    if name == HOG.name:
        return ExtraDescriptor(name, HOG().length, HOG().fingerprint)
    if name != FEATURES:
        expected = ", ".join((FEATURES, HOG.name, NONE))
        raise ValueError(f"expected a method of pictures, {expected}, got {name!r}")
    if segmenter is None:
        raise ValueError(f"{name} are of a network: expected images and a segmenter")
    return segmenter.features.descriptor
