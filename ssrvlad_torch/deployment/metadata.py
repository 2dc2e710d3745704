"""Metadata of an exported file: the ONNX metadata properties ``ssrvlad.*``."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..config import SSRVLADConfig, package_version
from ..files import InputError, input_errors, parse_json
from ..taxonomy import LabelSpace

PREFIX = "ssrvlad."

FORMAT = "2"
"""Version of the outputs and properties of a file. Programs refuse other versions."""

_DTYPES = ("uint8", "int32", "int64", "float32", "float64")
_MAX_GOLDEN_BYTES = 64 << 20

Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Metadata:
    """The metadata of an exported file.

    Attributes:
        version: version of this package.
        config, label_space: as `SSRVLADConfig.to_dict` and `LabelSpace.to_dict`.
        fingerprint: fingerprint of the settings.
        interface: ``opset``; ``inputs`` and ``outputs``: ``dtype`` and ``shape`` by name, an axis
            with a name is dynamic; ``sweep``, the anchors, where the head has several.
        golden: an input and the module's outputs for it; each array by name as ``dtype``, ``shape``
            and ``data``: its little-endian bytes, compressed by zlib, in base64.
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
        """The metadata of a head; a golden array above 64 MiB is a ValueError."""
        entries = {}
        for name, array in golden.items():
            if array.nbytes > _MAX_GOLDEN_BYTES:
                raise ValueError(f"golden {name} is {array.nbytes >> 20} MiB; expected at most 64")
            little = array.astype(array.dtype.newbyteorder("<"))
            data = base64.b64encode(zlib.compress(little.tobytes(), 9)).decode()
            entries[name] = {"dtype": array.dtype.name, "shape": list(array.shape), "data": data}
        settings = config.to_dict(), config.fingerprint
        return cls(package_version(), *settings, space.to_dict(), interface, entries)

    @classmethod
    def from_properties(cls, properties: Mapping[str, str]) -> Metadata:
        """The metadata in a file's properties; damage and another format are a ValueError."""
        file_format = properties.get(f"{PREFIX}format", "1")
        if f"{PREFIX}fingerprint" in properties and file_format != FORMAT:
            raise ValueError(f"a file of format {file_format}; expected {FORMAT}: export it again")
        values: dict[str, Any] = {}
        for field in fields(cls):
            name = PREFIX + field.name
            if name not in properties:
                raise ValueError(f"no metadata {name}: not a file of `ssrvlad export`")
            text = properties[name]
            if field.type == "str":
                values[field.name] = text
                continue
            values[field.name] = parse_json(text, f"metadata {name}")
            if not isinstance(values[field.name], dict):
                raise InputError(f"metadata {name} is {text[:40]}; expected a JSON object")
        return cls(**values)

    def to_properties(self) -> dict[str, str]:
        """One property for each attribute, as text or JSON."""
        return {
            PREFIX + name: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for name, value in asdict(self).items()
        }

    def golden_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The golden input and outputs by name; damage and more than 64 MiB are an InputError."""
        arrays = {}
        for name, entry in self.golden.items():
            with input_errors(f"golden {name}", "damaged"):
                dtype = np.dtype(entry["dtype"])
                shape = [abs(int(length)) for length in entry["shape"]]
                size = dtype.itemsize * math.prod(shape)
                if dtype.name not in _DTYPES or size > _MAX_GOLDEN_BYTES:
                    raise InputError(
                        f"golden {name} is {dtype.name} {shape}; expected at most 64 MiB"
                    )
                compressed = base64.b64decode(entry["data"], validate=True)
                content = zlib.decompressobj().decompress(compressed, size + 1)
                array = np.frombuffer(content, dtype.newbyteorder("<")).reshape(shape)
                arrays[name] = array.astype(dtype)
        return arrays
