"""The golden pair of a file, an input with its outputs, on this runtime."""

from __future__ import annotations

import base64
import json
import math
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .output import note, one_line

Array = npt.NDArray[Any]

TOLERANCE = 1e-6
MAX_OTHER_PIXELS = 0.01
"""Fraction of a golden image's pixels whose label may differ on another runtime."""
MIN_COSINE = 0.8
"""Cosine of the descriptors of two label maps that differ so little; unlike maps have less."""
MAX_OTHER_SIGNS = 0.01
"""Fraction of the signs of a golden image's features that may differ on another runtime."""

_MAX_GOLDEN_BYTES = 64 << 20


class Golden(NamedTuple):
    """The result of a golden pair: the largest difference of the descriptor, infinite if a count
    differs; the fraction of pixels with another label; the cosine to the expected descriptor; the
    fraction of other signs; the largest difference of HOG."""

    difference: float
    other_pixels: float = 0.0
    cosine: float = 1.0
    other_signs: float = 0.0
    hog: float = 0.0

    def __str__(self) -> str:
        other = f", {self.other_pixels:.2%} of the labels differ" if self.other_pixels else ""
        other += f", {self.other_signs:.2%} of the features differ" if self.other_signs else ""
        other += f", hog differs by {self.hog:.3g}" if self.hog > TOLERANCE else ""
        return f"largest difference for the golden pair: {self.difference:.3g}{other}"

    @property
    def holds(self) -> bool:
        """Whether the runtime can be trusted. Where some labels differ, the descriptor differs too,
        so only a large error of the head is found."""
        is_similar = self.other_pixels > 0 and self.cosine >= MIN_COSINE
        is_right = self.difference <= TOLERANCE or is_similar
        is_near = self.other_pixels <= MAX_OTHER_PIXELS and self.other_signs <= MAX_OTHER_SIGNS
        return is_near and is_right and self.hog <= TOLERANCE


def run_golden(session: Any, name: str, properties: dict[str, str]) -> Golden:
    """Runs the golden pair of a file.

    Args:
        session: the session of the file.
        name: name of its input.
        properties: its metadata.

    Raises:
        ValueError: it has none for the input, or cannot be run.
    """
    try:
        entries = json.loads(properties.get("ssrvlad.golden", "{}"))
        golden = {key: _array(entry) for key, entry in entries.items()}
    except (AttributeError, KeyError, TypeError, ValueError, zlib.error) as error:
        raise ValueError(f"the golden pair is damaged: {one_line(error)}") from error
    if name not in golden or len(golden) < 2 or (name == "labels" and "descriptor" not in golden):
        raise ValueError(f"no golden pair for input {name}; see `ssrvlad verify`")
    inputs = {name: golden.pop(name)}
    try:
        outputs = dict(zip(golden, session.run(list(golden), inputs), strict=True))
    except Exception as error:  # ONNX Runtime has no common error type
        raise ValueError(f"cannot run the golden pair: {one_line(error)}") from error
    if _forms(outputs) != _forms(golden):
        return Golden(float("inf"), cosine=0.0)
    other = float((outputs["labels"] != golden["labels"]).mean()) if "labels" in golden else 0.0
    signs = [each["features"] for each in (outputs, golden) if "features" in golden]
    others = float(np.unpackbits(signs[0] ^ signs[1]).mean()) if signs else 0.0
    hog = _largest(outputs["hog"], golden["hog"]) if "hog" in golden else 0.0
    if "descriptor" not in golden:
        return Golden(0.0, other, other_signs=others, hog=hog)
    got, expected = outputs["descriptor"], golden["descriptor"]
    counts = golden.keys() - {"descriptor", "labels", "features", "hog"}
    equal = all(np.array_equal(outputs[key], golden[key]) for key in counts)
    difference = _largest(got, expected) if equal else float("inf")
    cosine = np.nan_to_num((got * expected).sum(-1)).min()
    return Golden(difference, other, float(cosine), others, hog)


def require_golden(path: Path, golden: Golden) -> None:
    """Refuses a runtime whose golden pair is wrong."""
    if not golden.holds:
        raise ValueError(
            f"{path} is computed wrong here ({golden}); `ssrvlad verify --provider` says where, "
            "--unchecked runs it anyway"
        )
    if golden.difference > TOLERANCE:
        note(f"{path}: {golden}: the head was checked roughly; `ssrvlad verify` checks it exactly")


def _largest(got: Array, expected: Array) -> float:
    """The largest difference of two arrays, infinite for NaN."""
    return float(np.nan_to_num(np.abs(got - expected), nan=np.inf).max())


def _forms(arrays: dict[str, Array]) -> dict[str, Any]:
    return {name: (array.shape, array.dtype) for name, array in arrays.items()}


def _array(entry: dict[str, Any]) -> Array:
    """An array of the golden pair."""
    dtype = np.dtype(entry["dtype"])
    size = dtype.itemsize * math.prod(entry["shape"])
    if not 0 <= size <= _MAX_GOLDEN_BYTES:
        raise ValueError(f"the golden pair has an array of {size} bytes; expected at most 64 MiB")
    content = zlib.decompressobj().decompress(base64.b64decode(entry["data"]), size + 1)
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype).reshape(entry["shape"])
