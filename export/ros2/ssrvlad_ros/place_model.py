"""A file of `ssrvlad fuse` in ONNX Runtime: from pictures to label maps and features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssrvlad_torch.deployment.fuse import FEATURES, IMAGE, LABELS, problem_of_network
from ssrvlad_torch.deployment.metadata import PREFIX, Metadata
from ssrvlad_torch.files import one_line
from ssrvlad_torch.segmentation.onnx_files import open_session
from ssrvlad_torch.segmentation.segmenter import Segmented
from ssrvlad_torch.taxonomy import LabelSpace


class PlaceModel:
    """Labels pictures and takes their features in one pass.

    Args:
        path: a file of `ssrvlad fuse`, or the network's file of `ssrvlad fuse --split`.
        features: whether it must give features; without, they are left alone.
        check: whether to run the golden image and refuse a machine that gives other outputs.

    Attributes:
        fingerprint: of the settings of the head in the file.
        labels_as: label space of the label maps.
        fingerprint_of_features: under which a database stores them; empty without.

    Raises:
        ValueError: the file is of another kind or damaged, gives no features, or the golden image
            has other labels or features here.
        OSError: it cannot be read.
        ImportError: onnxruntime is not installed.
    """

    def __init__(self, path: Path, features: bool = True, check: bool = True) -> None:
        path.open("rb").close()
        self._path, self._session = path, open_session(path, path)
        given = [each.name for each in self._session.get_inputs()]
        names = [each.name for each in self._session.get_outputs()]
        if given != [IMAGE] or LABELS not in names:
            raise ValueError(
                f"{path}: expected a file of `ssrvlad fuse`, which takes {IMAGE} and gives "
                f"{LABELS}; got one that takes {', '.join(given)}"
            )
        properties = self._session.get_modelmeta().custom_metadata_map
        try:
            metadata = Metadata.from_properties(properties)
            golden = metadata.golden_arrays()
            self.labels_as = LabelSpace.from_dict({"source": "ssrvlad.", **metadata.label_space})
        except (ValueError, KeyError) as error:
            raise ValueError(f"{path}: {one_line(error)}") from error
        self.fingerprint, signs = metadata.fingerprint, properties.get(PREFIX + FEATURES, "")
        if features and not (signs and FEATURES in names):
            raise ValueError(
                f"{path} gives no features: fuse it again without --no-features, or set the "
                "parameter features to false"
            )
        self.fingerprint_of_features, self.problem_of_features = signs if features else "", ""
        self._outputs = [LABELS, FEATURES] if features else [LABELS]
        if check:
            wanted = {name: golden[name] for name in self._outputs}
            got = dict(zip(self._outputs, self._run(golden[IMAGE]), strict=True))
            if problem := problem_of_network(got, wanted):
                raise ValueError(f"{path} is computed wrong on this machine: {problem}")

    def __call__(self, pixels: npt.NDArray[np.uint8]) -> Segmented:
        """What the network says of a picture ``(H, W, 3)`` uint8 in RGB.

        Raises:
            ValueError: the network fails at this size, or its activations are not finite or the
                same everywhere.
        """
        labels, *features = (output[0] for output in self._run(pixels[None]))
        if features and not features[0].any():
            raise ValueError(
                "the activations of the network are not finite, or the same everywhere"
            )
        return Segmented(labels, *features)

    def _run(self, images: npt.NDArray[np.uint8]) -> list[npt.NDArray[Any]]:
        try:
            return list(self._session.run(self._outputs, {IMAGE: images}))
        except Exception as error:  # ONNX Runtime has no common error type
            size = "x".join(map(str, images.shape[1:3]))
            raise ValueError(f"{self._path} fails at {size}: {one_line(error)}") from error
