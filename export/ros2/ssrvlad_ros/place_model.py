"""A file of `ssrvlad fuse` in ONNX Runtime: from pictures to label maps and features."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.deployment.differences import FEATURES, IMAGE, LABELS, problem_of_network
from ssrvlad_torch.deployment.fuse import OF_PICTURES
from ssrvlad_torch.deployment.metadata import PREFIX, Metadata
from ssrvlad_torch.files import one_line
from ssrvlad_torch.segmentation.onnx_files import open_session
from ssrvlad_torch.segmentation.segmenter import Segmented
from ssrvlad_torch.taxonomy import LabelSpace


class PlaceModel:
    """Labels pictures and takes their features in one pass, as a `Segmenter` does. The package
    computes HOG of the same pictures, if the file's metadata has HOG.

    Args:
        path: a file of `ssrvlad fuse`, or the network's file of `ssrvlad fuse --split`.
        features: whether it must give features; without, they are left alone.
        check: whether to run the golden image and refuse a machine that gives other outputs.

    Attributes:
        fingerprint: of the settings of the head in the file.
        label_space: of the label maps.
        channels: names of what it gives of a frame beside the label map.
        fingerprint_of_features: under which a database stores them; empty without.

    Raises:
        ValueError: the file is of another kind or damaged, gives no features, or the golden image
            has other labels, features or HOG here.
        OSError: it cannot be read.
        ImportError: onnxruntime is not installed.
    """

    def __init__(self, path: Path, features: bool = True, check: bool = True) -> None:
        path.open("rb").close()
        self._path, self._session = path, open_session(path, path)
        inputs = [value.name for value in self._session.get_inputs()]
        names = [value.name for value in self._session.get_outputs()]
        if inputs != [IMAGE] or LABELS not in names:
            raise ValueError(
                f"{path}: expected a file of `ssrvlad fuse`, which takes {IMAGE} and gives "
                f"{LABELS}; got one that takes {', '.join(inputs)}"
            )
        properties = self._session.get_modelmeta().custom_metadata_map
        try:
            metadata = Metadata.from_properties(properties)
            golden = metadata.golden_arrays()
            self.label_space = LabelSpace.from_dict({"source": "ssrvlad.", **metadata.label_space})
        except (ValueError, KeyError) as error:
            raise ValueError(f"{path}: {one_line(error)}") from error
        self.fingerprint = metadata.fingerprint
        channels = [name for name in OF_PICTURES if name in names and properties.get(PREFIX + name)]
        if features and FEATURES not in channels:
            raise ValueError(
                f"{path} gives no features: fuse it again without --no-features, or set the "
                "parameter features to false"
            )
        self.channels = [name for name in channels if features or name != FEATURES]
        self.fingerprint_of_features = properties[PREFIX + FEATURES] if features else ""
        self.problem_of_features = ""
        if check:
            got = self._run(golden[IMAGE], features)
            if HOG.name in self.channels:
                views = [View("golden", picture=picture) for picture in golden[IMAGE]]
                got[HOG.name] = HOG().describe(views).numpy()
            if problem := problem_of_network(got, {name: golden[name] for name in got}):
                raise ValueError(f"{path} is computed wrong on this machine: {problem}")

    def segment(
        self, images: Sequence[npt.NDArray[np.uint8]], features: bool = False
    ) -> list[Segmented]:
        """What the network says of pictures of one size, ``(H, W, 3)`` uint8 in RGB.

        Raises:
            ValueError: the network fails at this size, or its activations are not finite or the
                same everywhere.
        """
        outputs = self._run(np.stack(images), features)
        if features and not outputs[FEATURES].any((1, 2, 3)).all():
            raise ValueError(
                "the activations of the network are not finite, or the same everywhere"
            )
        return [Segmented(*frame) for frame in zip(*outputs.values(), strict=True)]

    def _run(self, images: npt.NDArray[np.uint8], features: bool) -> dict[str, npt.NDArray[Any]]:
        names = [LABELS, FEATURES] if features else [LABELS]
        try:
            return dict(zip(names, self._session.run(names, {IMAGE: images}), strict=True))
        except Exception as error:  # ONNX Runtime has no common error type
            size = "x".join(map(str, images.shape[1:3]))
            raise ValueError(f"{self._path} fails at {size}: {one_line(error)}") from error
