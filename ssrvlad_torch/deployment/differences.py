"""How outputs of a graph differ from those that it must give, and by how much they may."""

import numpy as np
import numpy.typing as npt

from .metadata import Arrays

IMAGE, LABELS, FEATURES, HOG = "image", "labels", "features", "hog"
"""Names of the input and of outputs of a fused file."""

TOLERANCE = 1e-6
"""Largest difference of a number of a descriptor. Counts must be equal."""

MAX_OTHER_PIXELS, MAX_OTHER_SIGNS, MAX_OTHER_HOG = 0.01, 0.01, 1e-6
"""Of a golden image where another library or processor computes the network in another order: the
fraction of pixels with another label, that of other signs of features, and by how much a number of
HOG may differ."""


def difference_of(got: Arrays, expected: Arrays) -> tuple[float, str]:
    """The largest difference of two descriptors, and what is wrong or ``""``: counts must be equal,
    descriptors agree within `TOLERANCE`."""
    for name, array in expected.items():
        if got[name].shape != array.shape:
            return np.inf, f"{name} is {got[name].shape}, not {array.shape}"
    if not expected:
        return 0.0, ""
    steps = np.abs(got["descriptor"].astype(np.float64) - expected["descriptor"])
    largest = float(np.nan_to_num(steps, nan=np.inf).max(initial=0))
    far = [f"descriptors differ by {largest:.2g}"] if largest > TOLERANCE else []
    counts = [name for name in expected if name != "descriptor"]
    differ = [f"{name} differ" for name in counts if (got[name] != expected[name]).any()]
    return largest, ", ".join([*far, *differ])


def problem_of_network(got: Arrays, expected: Arrays) -> str:
    """What is wrong with labels and features of a golden image; empty if they are near enough."""
    if got[LABELS].shape != expected[LABELS].shape:
        return f"labels are {got[LABELS].shape}, not {expected[LABELS].shape}"
    fraction = float((got[LABELS] != expected[LABELS]).mean())
    if fraction > MAX_OTHER_PIXELS:
        return f"{fraction:.1%} of the pixels have another label"
    if FEATURES in expected:
        fraction = other_signs(got[FEATURES], expected[FEATURES])
        if fraction > MAX_OTHER_SIGNS:
            return f"{fraction:.1%} of the signs of the features are others"
    if HOG in expected:
        difference = np.abs(got[HOG].astype(np.float64) - expected[HOG]).max(initial=0)
        if not difference <= MAX_OTHER_HOG:
            return f"hog differs by {difference:.2g}"
    return ""


def other_signs(signs: npt.NDArray[np.uint8], expected: npt.NDArray[np.uint8]) -> float:
    """The fraction of signs that differ; 1 for another shape."""
    same_shape = signs.shape == expected.shape
    return float(np.unpackbits(signs ^ expected).mean()) if same_shape else 1.0
