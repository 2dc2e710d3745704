"""A file of `ssrvlad export` or `ssrvlad fuse` in ONNX Runtime."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import onnxruntime

from .frames import SUFFIXES, SUFFIXES_OF_MAPS, read_labels, read_photograph, read_scores
from .golden import TOLERANCE, Golden, require_golden, run_golden
from .output import one_line

Array = npt.NDArray[Any]

LABEL_SHAPES, FEATURES, HOG = "ssr-vlad", "features", "hog"
TRUST = {LABEL_SHAPES: 1.0, FEATURES: 6.0, HOG: 2.0}
"""How much each channel counts before anything is known of a drive, as in `ssrvlad query`."""

CPU = "CPUExecutionProvider"
FORMAT = "2"

_ONLY_FATAL = 4


class Seen(NamedTuple):
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
        self.session = _session(path, provider)
        self.properties = _properties(path, self.session)
        self.input = _input(path, self.session)
        self.dtype = _dtype(self.input.type)
        if check:
            require_golden(path, self.golden())

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the settings; descriptors of another one do not compare."""
        return str(self.properties["ssrvlad.fingerprint"])

    @property
    def fingerprints(self) -> dict[str, str]:
        """Fingerprints of the channels that the file gives, by name; that of label maps first."""
        return {LABEL_SHAPES: self.fingerprint, **_of_pictures(self.properties)}

    @property
    def anchors(self) -> list[int]:
        """Columns of the anchors of a sweep; empty for single descriptors."""
        return list(json.loads(self.properties.get("ssrvlad.interface", "{}")).get("sweep", []))

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Suffixes of the files that it takes."""
        if len(self.input.shape) == 3:
            return SUFFIXES_OF_MAPS
        return (".npy",) if self.input.name == "logits" else SUFFIXES

    def see(self, path: Path) -> Seen:
        """The channels of the frame in a file.

        Raises:
            ValueError: it cannot be read, or as of `see_array`.
        """
        read: Callable[[Path], Array] = read_photograph
        if len(self.input.shape) == 3:
            classes = json.loads(self.properties["ssrvlad.label_space"])["classes"]
            read = partial(read_labels, classes=classes, dtype=self.dtype)
        elif self.input.name == "logits":
            read = partial(read_scores, dtype=self.dtype)
        try:
            return self.see_array(read(path))
        except ImportError:
            raise
        except Exception as error:  # decoders raise anything on damaged bytes
            raise ValueError(one_line(error)) from error

    def see_array(self, array: Array) -> Seen:
        """The channels of a frame in memory: the input of the file without the batch axis.

        Raises:
            ValueError: it has ids outside the label space, more than the file can count, or another
                size than the fixed size of the file; or the network sees nothing in it.
        """
        expected, shape = self.input.shape, (1, *array.shape)
        if any(isinstance(n, int) and n != m for n, m in zip(expected, shape, strict=True)):
            raise ValueError(f"the file takes {self.input.name} of {tuple(expected)}, got {shape}")
        descriptor, unknown, *others = self._run(array[None])
        if unknown[0]:
            space = json.loads(self.properties["ssrvlad.label_space"])["name"]
            channels = {"labels": 1, "logits": array.shape[0]}.get(self.input.name, 3)
            raise ValueError(
                f"{unknown[0]} of {array.size // channels} pixels have an id outside label space "
                f"{space}"
            )
        if not np.isfinite(descriptor).all():
            raise ValueError(
                "the frame is too wide, or has too many keypoints, for an exported file"
            )
        seen = {name: each[0] for name, each in zip([*self.fingerprints][1:], others, strict=True)}
        if FEATURES in seen and not seen[FEATURES].any():
            raise ValueError(
                "the activations of the network are not finite, or the same everywhere"
            )
        return Seen(np.asarray(descriptor[0]), **seen)

    def golden(self) -> Golden:
        """Runs the golden pair.

        Raises:
            ValueError: the file has no golden pair for its input, or cannot run it.
        """
        return run_golden(self.session, self.input.name, self.properties)

    def _run(self, batch: Array) -> list[Array]:
        names = ["descriptor", "unknown", *[*self.fingerprints][1:]]
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
        self.network = _session(network, provider)
        self.network_properties = _properties(network, self.network)
        for name in ("ssrvlad.fingerprint", "ssrvlad.label_space"):
            if self.network_properties[name] != self.properties[name]:
                raise ValueError(f"{network} and {head} differ in {name}: expected the two files")
        labels, self.input = self.input, _input(network, self.network)
        outputs = [(output.name, output.type) for output in self.network.get_outputs()]
        if outputs[:1] != [("labels", labels.type)] or labels.name != "labels":
            raise ValueError(f"{network} gives {outputs}, {head} takes {labels.name} {labels.type}")
        if check:
            golden = self.golden()
            require_golden(network if golden.difference <= TOLERANCE else head, golden)

    @property
    def fingerprints(self) -> dict[str, str]:
        """As of `Model`; the file of the network gives the channels of pictures."""
        return {LABEL_SHAPES: self.fingerprint, **_of_pictures(self.network_properties)}

    def golden(self) -> Golden:
        """Runs the golden pairs of both files."""
        head = run_golden(self.session, "labels", self.properties)
        network = run_golden(self.network, "image", self.network_properties)
        others = {"other_pixels": network.other_pixels, "other_signs": network.other_signs}
        hog = max(head.hog, network.hog)
        return head._replace(**others, hog=hog) if head.holds else head

    def _run(self, batch: Array) -> list[Array]:
        image = onnxruntime.OrtValue.ortvalue_from_numpy(batch)
        names = ["labels", *[*self.fingerprints][1:]]
        labels, *others = self.network.run_with_ort_values(names, {"image": image})
        outputs = self.session.run_with_ort_values(["descriptor", "unknown"], {"labels": labels})
        return [output.numpy() for output in [*outputs, *others]]


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


def _session(path: Path, provider: str) -> Any:
    path.open("rb").close()
    available = onnxruntime.get_available_providers()
    if provider not in available:
        raise ValueError(f"no provider {provider}; expected one of {', '.join(available)}")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ONLY_FATAL
    providers = [*dict.fromkeys((provider, CPU))]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # ONNX Runtime has no common error type
        raise ValueError(f"{path}: {one_line(error)}") from error


def _properties(path: Path, session: Any) -> dict[str, str]:
    properties = dict(session.get_modelmeta().custom_metadata_map)
    if "ssrvlad.fingerprint" not in properties or "ssrvlad.label_space" not in properties:
        raise ValueError(f"{path}: no metadata ssrvlad.*: not a file of `ssrvlad export` or `fuse`")
    number = properties.get("ssrvlad.format", "1")
    if number != FORMAT:
        raise ValueError(f"{path}: a file of format {number}; expected {FORMAT}: export it again")
    return properties


def _of_pictures(properties: dict[str, str]) -> dict[str, str]:
    """Fingerprints of the channels of pictures in a file."""
    named = {name: properties.get(f"ssrvlad.{name}", "") for name in (FEATURES, HOG)}
    return {name: fingerprint for name, fingerprint in named.items() if fingerprint}


def _input(path: Path, session: Any) -> Any:
    inputs = session.get_inputs()
    if len(inputs) != 1 or len(inputs[0].shape) not in (3, 4):
        names = ", ".join(f"{each.name} {each.shape}" for each in inputs)
        raise ValueError(f"{path}: expected one input of labels, scores or images, got {names}")
    return inputs[0]


def _dtype(onnx_type: str) -> Any:
    """``tensor(uint8)`` -> ``uint8``."""
    name = onnx_type.removeprefix("tensor(").removesuffix(")")
    return np.dtype({"float": "float32", "double": "float64"}.get(name, name))
