"""What an exported file says about itself, as the ONNX metadata properties ``ssrvlad.*``."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..config import SSRVLADConfig
from ..taxonomy import LabelSpace
from ..untrusted import InputError, naming, parse_json

PREFIX = "ssrvlad."

SEAL = f"{PREFIX}sha256"
"""The property that `seal` gives."""

FORMAT = "2"
"""Of the outputs and properties of a file. Programs refuse a file of another."""

_DTYPES = ("uint8", "int32", "int64", "float32", "float64")
_MOST_GOLDEN = 64 << 20

Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Metadata:
    """What an exported file says about itself.

    Attributes:
        version: of this package.
        config: every setting by name, as `SSRVLADConfig.to_dict`.
        fingerprint: of the config.
        label_space: as `LabelSpace.to_dict`.
        interface: ``opset``; ``form``, as for `export_head`; ``inputs`` and ``outputs``, which give
            ``dtype`` and ``shape`` by name; an axis with a name is dynamic.
        golden: an input and the module's outputs for it; each array by name as ``dtype``, ``shape``
            and ``data``, its little-endian bytes compressed by zlib, in base64.
        format: `FORMAT`.
    """

    version: str
    config: dict[str, Any]
    fingerprint: str
    label_space: dict[str, Any]
    interface: dict[str, Any]
    golden: dict[str, dict[str, Any]]
    format: str = FORMAT

    @classmethod
    def of(
        cls, config: SSRVLADConfig, space: LabelSpace, interface: dict[str, Any], golden: Arrays
    ) -> Metadata:
        """The metadata of a head with these settings.

        Raises:
            ValueError: a golden array is larger than `golden_arrays` reads.
        """
        return cls(
            version=__version__,
            config=config.to_dict(),
            fingerprint=config.fingerprint,
            label_space=space.to_dict(),
            interface=interface,
            golden={name: _to_text(name, array) for name, array in golden.items()},
        )

    @classmethod
    def from_properties(cls, properties: Mapping[str, str]) -> Metadata:
        """The metadata in a file's properties.

        Raises:
            ValueError: a property is missing or is not what `to_properties` writes, or the file is
                of another format.
        """
        written = properties.get(f"{PREFIX}format", "1")
        if f"{PREFIX}fingerprint" in properties and written != FORMAT:
            raise ValueError(f"a file of format {written}; expected {FORMAT}: export it again")
        found: dict[str, Any] = {}
        for field in fields(cls):
            name = PREFIX + field.name
            if name not in properties:
                raise ValueError(f"no metadata {name}: this is no file of `ssrvlad export`")
            text = properties[name]
            if field.type == "str":
                found[field.name] = text
                continue
            found[field.name] = parse_json(text, f"metadata {name}")
            if not isinstance(found[field.name], dict):
                raise InputError(f"metadata {name} is {text[:40]}; expected a JSON object")
        return cls(**found)

    def to_properties(self) -> dict[str, str]:
        """One property for each attribute, as text or as JSON."""
        return {
            PREFIX + name: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for name, value in asdict(self).items()
        }

    def golden_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The golden input and outputs by name."""
        return {name: _from_text(name, entry) for name, entry in self.golden.items()}


def seal(graph: str, properties: Mapping[str, str]) -> str:
    """SHA-256 of a graph's digest and of every property ``ssrvlad.*``, in hex: what it is changes
    where either is edited."""
    ours = {name: text for name, text in properties.items() if name.startswith(PREFIX)}
    ours.pop(SEAL, None)
    return hashlib.sha256(json.dumps([graph, ours], sort_keys=True).encode()).hexdigest()


def _to_text(name: str, array: npt.NDArray[Any]) -> dict[str, Any]:
    if array.nbytes > _MOST_GOLDEN:
        raise ValueError(f"golden {name} is {array.nbytes >> 20} MiB; expected at most 64")
    little = array.astype(array.dtype.newbyteorder("<"))
    data = base64.b64encode(zlib.compress(little.tobytes(), 9)).decode()
    return {"dtype": array.dtype.name, "shape": list(array.shape), "data": data}


def _from_text(name: str, entry: Any) -> npt.NDArray[Any]:
    """A golden array from what `Metadata` holds of it.

    Raises:
        InputError: it is damaged, or larger than 64 MiB.
    """
    with naming(f"golden {name}", "damaged"):
        dtype, shape = np.dtype(entry["dtype"]), [abs(int(length)) for length in entry["shape"]]
        expected = dtype.itemsize * math.prod(shape)
        if dtype.name not in _DTYPES or expected > _MOST_GOLDEN:
            raise InputError(f"golden {name} is {dtype.name} {shape}; expected at most 64 MiB")
        compressed = base64.b64decode(entry["data"], validate=True)
        content = zlib.decompressobj().decompress(compressed, expected + 1)
        return np.frombuffer(content, dtype.newbyteorder("<")).reshape(shape).astype(dtype)
