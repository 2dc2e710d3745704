#!/usr/bin/env python3
"""Not run with RTAB-Map itself: the tests call it as RTAB-Map's `PyDescriptor.cpp` does.

The script that RTAB-Map calls for a global descriptor: pixels in, float32 (1, D) out.

rtabmap --Mem/GlobalDescriptorStrategy 1 --Kp/TfIdfLikelihoodUsed false \
        --Mem/RehearsalSimilarity 1 --PyDescriptor/Dim 480 \
        --PyDescriptor/Path export/rtabmap_ssrvlad.py

Needs what `run_onnx.py` needs, and a file of `ssrvlad fuse`:
`place.onnx` beside it, or the one that `rtabmap_ssrvlad.json` beside it names:
{"model": "other.onnx"}.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.append(str(Path(__file__).resolve().parent))
if not hasattr(sys, "argv"):  # as in an embedded interpreter
    sys.argv = [""]

from ssrvlad_place.model import Model
from ssrvlad_place.output import note

from ssrvlad_torch.files import one_line

SETTINGS = Path(__file__).resolve().with_suffix(".json")

_extractor: Extractor | None = None
_failure = "init() was not called"


class Extractor:
    """Describes RTAB-Map's images by a fused file.

    Args:
        settings: JSON file as above; without it, `place.onnx` in its folder.
        dimension: of ``PyDescriptor/Dim``, which must be the length of the descriptors.

    Raises:
        ValueError: a file has wrong content; the message names it.
        OSError: a file cannot be read.
    """

    def __init__(self, settings: Path, dimension: int) -> None:
        options: dict[str, Any] = {"model": "place.onnx"}
        if settings.exists():
            options |= json.loads(settings.read_text(encoding="utf-8"))
        path = settings.parent / options.pop("model")
        if options:
            raise ValueError(f"{settings}: no setting {', '.join(sorted(options))}")
        self.model = Model(path)
        if len(self.model.input.shape) != 4 or self.model.input.name == "logits":
            raise ValueError(f"{path}: expected a file of `ssrvlad fuse`, whose input is images")
        length = self.model.session.get_outputs()[0].shape[1]
        if dimension != length:
            raise ValueError(f"{path} gives {length} numbers; set PyDescriptor/Dim, {dimension}")

    def __call__(self, image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """The descriptor of an image, zero if nothing in it belongs to a category.

        Args:
            image: ``(H, W, 3)`` BGR or ``(H, W, 1)`` gray, in bytes. RTAB-Map declares them as
                signed (``NPY_BYTE``); they are unsigned.

        Returns:
            ``(1, D)`` float32 of length 1 or zero.

        Raises:
            ValueError: the image has another form or is too wide, or the network gives ids that the
                label space lacks.
        """
        pixels = np.ascontiguousarray(image)
        if pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or pixels.itemsize != 1:
            raise ValueError(
                f"expected (H, W, 3) or (H, W, 1) bytes, got {image.shape} {image.dtype}"
            )
        blue_first = np.broadcast_to(pixels.view(np.uint8), (*pixels.shape[:2], 3))
        descriptor = self.model.see_array(np.ascontiguousarray(blue_first[..., ::-1])).descriptor
        return np.ascontiguousarray(descriptor[None], np.float32)


def init(descriptor_dimension: int) -> None:
    """RTAB-Map calls it once. An exception here would end RTAB-Map, so an error is printed on
    stderr, and raised by every `extract`, where RTAB-Map logs it."""
    global _extractor, _failure  # noqa: PLW0603
    try:
        _extractor = Extractor(SETTINGS, descriptor_dimension)
    except Exception as error:  # see above
        _extractor, _failure = None, one_line(error)
        note(f"rtabmap_ssrvlad: {_failure}")


def extract(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """RTAB-Map calls it for every image; see `Extractor`.

    Raises:
        RuntimeError: `init` failed, or was not called.
        ValueError: the image cannot be described.
    """
    if _extractor is None:
        raise RuntimeError(f"rtabmap_ssrvlad: {_failure}")
    return _extractor(image)
