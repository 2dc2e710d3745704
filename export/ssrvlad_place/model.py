"""A file of `ssrvlad export` or `ssrvlad fuse` in ONNX Runtime."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import onnxruntime
from numpy.lib.format import MAGIC_PREFIX

from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.deployment.differences import TOLERANCE
from ssrvlad_torch.deployment.metadata import PREFIX, Metadata
from ssrvlad_torch.files import naming, one_line, parse_npy
from ssrvlad_torch.segmentation.onnx_files import CPU, open_session
from ssrvlad_torch.taxonomy import LabelSpace

from .golden import Golden, require_golden, run_golden

Array = npt.NDArray[Any]

STDIN = Path("-")
LABEL_SHAPES, FEATURES, HOG = "ssr-vlad", "features", "hog"
TRUST = {LABEL_SHAPES: 1.0, FEATURES: 6.0, HOG: 2.0}
"""How much each channel counts before anything is known of a sequence, as in `ssrvlad query`."""


class Description(NamedTuple):
    """A frame: its descriptor ``(D,)`` float32 of length 1, or zeros for an empty frame, with
    `ssrvlad export --sweep` ``(S, D)``, one for each anchor; its features ``(16, 16, 16)`` uint8
    and its HOG ``(480,)`` float32, or ``None`` if the file does not give them."""

    descriptor: Array
    features: Array | None = None
    hog: Array | None = None

    @property
    def channels(self) -> dict[str, Array]:
        """What is there, by the names of the channels."""
        named = {LABEL_SHAPES: self.descriptor, FEATURES: self.features, HOG: self.hog}
        return {name: array for name, array in named.items() if array is not None}


class Model:
    """A file of `ssrvlad export` or `ssrvlad fuse`, loaded.

    Args:
        path: the file.
        provider: execution provider of ONNX Runtime; operators that it lacks run on the CPU.
        check: whether to run the golden pair and refuse a runtime that gives other outputs.

    Raises:
        ValueError: the file is of another kind or format, or its golden pair gives other outputs.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, provider: str = CPU, check: bool = True) -> None:
        self.session, self.metadata, properties = _opened(path, provider)
        self.space = LabelSpace.from_dict({"source": PREFIX, **self.metadata.label_space})
        self.input = _input(path, self.session)
        self.fingerprints = _fingerprints(self.metadata, properties)
        if check:
            require_golden(path, self.golden())

    @property
    def anchors(self) -> list[int]:
        """Columns of the anchors of a sweep; empty for single descriptors."""
        return list(self.metadata.interface.get("sweep", []))

    def frames(self, sources: Sequence[Path]) -> Iterable[FrameFile]:
        """The frames of folders and files, as `ssrvlad encode` finds them; of `STDIN` the files
        whose names arrive on standard input, one a line, as they come.

        Raises:
            ValueError: a source does not exist or holds no frame, or two frames have one id.
        """
        if list(sources) == [STDIN]:
            lines = map(os.fsdecode, sys.stdin.buffer)
            paths = (Path(line.rstrip("\r\n")) for line in lines if line.strip())
            return (FrameFile(path.absolute().parent.name, path.stem, path) for path in paths)
        find = find_image_files if self.input.name == "image" else find_label_files
        return list(find([*map(str, sources)]))

    def see(self, file: FrameFile) -> Description:
        """The channels of a frame: a label map, class scores in a ``.npy`` file, or a picture.

        Raises:
            ValueError: it cannot be read, or as of `see_array`.
        """
        if self.input.name == "image":
            return self.see_array(read_image(file))
        if self.input.name == "logits":
            content = file.read()
            if not content.startswith(MAGIC_PREFIX):
                raise ValueError("expected scores (C, H, W) in a .npy file, got another kind")
            scores = parse_npy(content)
            if scores.ndim != 3 or scores.dtype.kind != "f" or not np.isfinite(scores).all():
                raise ValueError(
                    f"expected finite scores (C, H, W), got {scores.shape} {scores.dtype}"
                )
            return self.see_array(scores.astype(np.float32))
        labels = read_label_map(file, self.space)
        dtype = np.dtype(self.metadata.interface["inputs"]["labels"]["dtype"])
        changed = int((labels.astype(dtype) != labels).sum())
        if changed:
            raise ValueError(f"{changed} of {labels.size} pixels have an id outside {dtype}")
        return self.see_array(labels.astype(dtype))

    def see_array(self, array: Array) -> Description:
        """The channels of a frame in memory: the input of the file without the batch axis.

        Raises:
            ValueError: it has ids outside the label space, more than the file can count, or another
                size than the fixed size of the file; or the network fails, or sees nothing in it.
        """
        expected, shape = self.input.shape, (1, *array.shape)
        if any(isinstance(n, int) and n != m for n, m in zip(expected, shape, strict=True)):
            raise ValueError(f"the file takes {self.input.name} of {tuple(expected)}, got {shape}")
        try:
            descriptor, unknown, *batches = self._run(array[None])
        except Exception as error:  # ONNX Runtime has no common error type
            raise ValueError(f"the file fails at {shape}: {one_line(error)}") from error
        if unknown[0]:
            channels = {"labels": 1, "logits": array.shape[0]}.get(self.input.name, 3)
            raise ValueError(
                f"{unknown[0]} of {array.size // channels} pixels have an id outside label space "
                f"{self.space.name}"
            )
        if not np.isfinite(descriptor).all():
            raise ValueError(
                "the frame is too wide, or has too many keypoints, for an exported file"
            )
        of_pictures = {name: batch[0] for name, batch in zip(self.pictures, batches, strict=True)}
        if FEATURES in of_pictures and not of_pictures[FEATURES].any():
            raise ValueError(
                "the activations of the network are not finite, or the same everywhere"
            )
        return Description(np.asarray(descriptor[0]), **of_pictures)

    def golden(self) -> Golden:
        """Runs the golden pair.

        Raises:
            ValueError: the file has no golden pair for its input, or cannot run it.
        """
        return run_golden(self.session, self.input.name, self.metadata)

    @property
    def pictures(self) -> list[str]:
        """The channels of pictures that the file gives."""
        return [name for name in self.fingerprints if name != LABEL_SHAPES]

    def _run(self, batch: Array) -> list[Array]:
        names = ["descriptor", "unknown", *self.pictures]
        return list(self.session.run(names, {self.input.name: batch}))


class Split(Model):
    """The two files of `ssrvlad fuse --split`: the network on a provider, the head on the CPU. The
    label map is not copied between them, except once from a GPU.

    Args:
        network: pictures to label maps.
        head: label maps to descriptors.
        provider: execution provider of the network.
        check: as for `Model`, for both files.

    Raises:
        ValueError: as `Model`, or the files were not written together.
        OSError: a file cannot be read.
    """

    def __init__(self, network: Path, head: Path, provider: str = CPU, check: bool = True) -> None:
        super().__init__(head, CPU, check=False)
        self.network, self.of_network, properties = _opened(network, provider)
        for name in ("fingerprint", "label_space"):
            if getattr(self.of_network, name) != getattr(self.metadata, name):
                raise ValueError(f"{network} and {head} differ in {name}: expected the two files")
        labels, self.input = self.input, _input(network, self.network)
        outputs = [(output.name, output.type) for output in self.network.get_outputs()]
        if outputs[:1] != [("labels", labels.type)] or labels.name != "labels":
            raise ValueError(f"{network} gives {outputs}, {head} takes {labels.name} {labels.type}")
        self.fingerprints = _fingerprints(self.of_network, properties)
        if check:
            golden = self.golden()
            require_golden(network if golden.difference <= TOLERANCE else head, golden)

    def golden(self) -> Golden:
        """Runs the golden pairs of both files."""
        head = run_golden(self.session, "labels", self.metadata)
        network = run_golden(self.network, "image", self.of_network)
        return Golden(head.difference, head.problem or network.problem)

    def _run(self, batch: Array) -> list[Array]:
        image = onnxruntime.OrtValue.ortvalue_from_numpy(batch)
        names = ["labels", *self.pictures]
        labels, *batches = self.network.run_with_ort_values(names, {"image": image})
        outputs = self.session.run_with_ort_values(["descriptor", "unknown"], {"labels": labels})
        return [output.numpy() for output in [*outputs, *batches]]


def open_model(options: argparse.Namespace) -> Model:
    """The model that the command line names."""
    check = not (options.unchecked or getattr(options, "check", False))
    if options.network:
        return Split(options.network, options.model, options.provider, check)
    return Model(options.model, options.provider, check)


def add_model(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments that `open_model` reads."""
    parser.add_argument("model", type=Path, help="the .onnx file")
    parser.add_argument("--network", type=Path, help="network file of `fuse --split`")
    parser.add_argument("--provider", default=CPU, help="of the network, or of a single file")
    parser.add_argument("--unchecked", action="store_true", help="do not run the golden pair first")


def _opened(path: Path, provider: str) -> tuple[Any, Metadata, dict[str, str]]:
    """The session of a file, its metadata, and all its properties."""
    if not path.exists():
        raise ValueError(f"{path} does not exist")
    available = onnxruntime.get_available_providers()
    if provider not in available:
        raise ValueError(f"no provider {provider}; expected one of {', '.join(available)}")
    session = open_session(path, path, provider)
    properties = session.get_modelmeta().custom_metadata_map
    with naming(path):
        return session, Metadata.from_properties(properties), properties


def _fingerprints(metadata: Metadata, properties: dict[str, str]) -> dict[str, str]:
    """Of the channels that a file gives, by name; that of label maps first."""
    named = {name: properties.get(PREFIX + name, "") for name in (FEATURES, HOG)}
    return {LABEL_SHAPES: metadata.fingerprint} | {name: key for name, key in named.items() if key}


def _input(path: Path, session: Any) -> Any:
    inputs = session.get_inputs()
    if len(inputs) != 1 or inputs[0].name not in ("labels", "logits", "image"):
        names = ", ".join(f"{value.name} {value.shape}" for value in inputs)
        raise ValueError(f"{path}: expected one input of labels, scores or images, got {names}")
    return inputs[0]
