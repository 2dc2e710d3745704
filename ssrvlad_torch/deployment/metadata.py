"""What an exported file says about itself, as the ONNX metadata properties ``ssrvlad.*``."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..config import SSRVLADConfig
from ..taxonomy import LabelSpace

PREFIX = "ssrvlad."

Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Metadata:
    """What an exported file says about itself.

    Attributes:
        version: of this package.
        config: every setting by name, as `SSRVLADConfig.to_dict`.
        fingerprint: of the config.
        label_space: as `LabelSpace.to_dict`.
        interface: ``opset``, and ``inputs`` and ``outputs``, which give ``dtype`` and ``shape`` by
            name; an axis with a name is dynamic.
        golden: an input and the module's outputs for it; each array by name as ``dtype``, ``shape``
            and ``data``, its little-endian bytes compressed by zlib, in base64.
    """

    version: str
    config: dict[str, Any]
    fingerprint: str
    label_space: dict[str, Any]
    interface: dict[str, Any]
    golden: dict[str, dict[str, Any]]

    @classmethod
    def of(
        cls, config: SSRVLADConfig, space: LabelSpace, interface: dict[str, Any], golden: Arrays
    ) -> Metadata:
        """The metadata of a head with these settings."""
        return cls(
            version=__version__,
            config=config.to_dict(),
            fingerprint=config.fingerprint,
            label_space=space.to_dict(),
            interface=interface,
            golden={name: _to_text(array) for name, array in golden.items()},
        )

    @classmethod
    def from_properties(cls, properties: Mapping[str, str]) -> Metadata:
        """The metadata in a file's properties.

        Raises:
            ValueError: a property is missing or is not what `to_properties` writes.
        """
        found: dict[str, Any] = {}
        for field in fields(cls):
            name = PREFIX + field.name
            if name not in properties:
                raise ValueError(f"no metadata {name}: this is no file of `ssrvlad export`")
            text = properties[name]
            try:
                found[field.name] = text if field.type == "str" else json.loads(text)
            except json.JSONDecodeError as error:
                raise ValueError(f"metadata {name} is not JSON: {error}") from error
        return cls(**found)

    def to_properties(self) -> dict[str, str]:
        """One property for each attribute, as text or as JSON."""
        return {
            PREFIX + name: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for name, value in asdict(self).items()
        }

    def golden_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The golden input and outputs by name."""
        return {name: _from_text(entry) for name, entry in self.golden.items()}


def _to_text(array: npt.NDArray[Any]) -> dict[str, Any]:
    little = array.astype(array.dtype.newbyteorder("<"))
    data = base64.b64encode(zlib.compress(little.tobytes(), 9)).decode()
    return {"dtype": array.dtype.name, "shape": list(array.shape), "data": data}


def _from_text(entry: Mapping[str, Any]) -> npt.NDArray[Any]:
    dtype = np.dtype(entry["dtype"]).newbyteorder("<")
    expected = dtype.itemsize * int(np.prod(entry["shape"], dtype=np.int64))
    content = zlib.decompressobj().decompress(base64.b64decode(entry["data"]), expected + 1)
    return np.frombuffer(content, dtype).reshape(entry["shape"]).astype(entry["dtype"])
