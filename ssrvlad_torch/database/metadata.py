"""The metadata of a database: columns of descriptors, settings, and the origins of label maps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from ..channels import Column
from ..config import SSRVLADConfig
from ..files import InputError, input_errors
from ..taxonomy import LabelSpace, label_space_names
from .rows import schema

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT = "ssrvlad-database-6"

_META, _DIGEST, _ORIGIN = "ssrvlad", "ssrvlad-digest", "origin:"


class Origin(NamedTuple):
    """The label space of label maps, ``None`` if unknown, and the network that made them, if they
    were not read from files: its identity, and the name that opens it again, if known, which is not
    part of the key."""

    label_space: LabelSpace | None = None
    segmenter: str = ""
    network: str = ""

    @property
    def key(self) -> str:
        """16 hex digits, a hash of `LabelSpace.digest` and the segmenter."""
        return _digest(json.dumps([self.label_space and self.label_space.digest, self.segmenter]))

    def __str__(self) -> str:
        name = self.label_space.name if self.label_space else "unknown"
        return f"{name} by {self.network or self.segmenter}" if self.segmenter else name

    def to_entry(self) -> dict[str, str]:
        """The origin as an entry of a table's metadata."""
        space = self.label_space and self.label_space.to_dict()
        return {_ORIGIN + self.key: json.dumps({**self._asdict(), "label_space": space})}

    @classmethod
    def of_entry(cls, key: str, text: str) -> Origin:
        """The origin that `to_entry` wrote."""
        stored = json.loads(text)
        space = stored.pop("label_space")
        origin = cls(space and LabelSpace.from_dict(space), **stored)
        if not isinstance(origin.network, str) or origin.key != key:
            raise ValueError(f"origin {key} does not match its content")
        return origin


class TableMetadata(NamedTuple):
    """A table's metadata: the settings of the first column (or ``None``), the columns of
    descriptors, and origins by their keys."""

    config: SSRVLADConfig | None
    columns: tuple[Column, ...]
    origins: dict[str, Origin]

    @staticmethod
    def to_dict(config: SSRVLADConfig | None, columns: Sequence[Column]) -> dict[str, str]:
        """The entries of a new table, which has no origins."""
        content = {
            "format": FORMAT,
            "config": config and config.to_dict(),
            "columns": [column._asdict() for column in columns],
        }
        text = json.dumps(content)
        return {_META: text, _DIGEST: _digest(text)}

    @classmethod
    def of(cls, stored: pa.Schema, path: str) -> TableMetadata:
        """The metadata in the schema of the table at ``path``. A table that is no database of this
        format, is damaged, or was made by another version of the method is a ValueError."""
        with input_errors(path, "damaged, or a database of another version"):
            entries = {
                key.decode(): value.decode() for key, value in (stored.metadata or {}).items()
            }
            text = entries.get(_META, "{}")
            content = json.loads(text)
            form = content.get("format", "")
            if form != FORMAT and form.startswith("ssrvlad-"):
                raise InputError(f"{path} has another format, {form}: encode it again")
            if form != FORMAT:
                raise InputError(f"{path} is a table of Lance, but not a database of {FORMAT}")
            if entries.get(_DIGEST) != _digest(text):  # Lance does not notice a flipped byte
                raise InputError(f"{path} is damaged: the checksum of its settings does not match")
            columns = tuple(
                Column(**{**column, "shape": tuple(column["shape"])})
                for column in content["columns"]
            )
            if not stored.equals(schema(columns)):
                raise InputError(f"{path} has other columns than a database of this version")
            config = content["config"] and SSRVLADConfig.from_dict(content["config"])
            space = config and config.labels_as
            if isinstance(space, str) and space not in label_space_names():
                raise ValueError(f"label space {space!r}; expected a built-in one")
            if config and config.fingerprint != columns[0].fingerprint:
                raise InputError(
                    f"{path} has fingerprint {columns[0].fingerprint}, made by another version of "
                    f"the method; the same settings have {config.fingerprint} here: encode it again"
                )
            origins = {
                key: Origin.of_entry(key, entries[name])
                for name in entries
                if (key := name.removeprefix(_ORIGIN)) != name
            }
        return cls(config, columns, origins)


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
