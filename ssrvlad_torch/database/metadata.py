"""The metadata of a database: columns of descriptors, settings, and the origins of label maps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..channels import Column
from ..config import SSRVLADConfig
from ..taxonomy import LabelSpace

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


class Meta(NamedTuple):
    """A table's metadata: the settings of the first column (or ``None``), the columns of
    descriptors, and origins by their keys."""

    config: SSRVLADConfig | None
    columns: tuple[Column, ...]
    origins: dict[str, Origin]

    @staticmethod
    def to_dict(config: SSRVLADConfig | None, columns: Sequence[Column]) -> dict[str, str]:
        """The entries of a new table, which has no origins."""
        text = json.dumps(
            {
                "format": FORMAT,
                "config": config and config.to_dict(),
                "columns": [column._asdict() for column in columns],
            }
        )
        return {_META: text, _DIGEST: _digest(text)}

    @classmethod
    def of(cls, entries: Mapping[bytes, bytes], path: str) -> Meta:
        """The metadata in the entries of the table at ``path``. A table that is no database of this
        format, is damaged, or was made by another version of the method is a ValueError."""
        texts = {key.decode(): value.decode() for key, value in entries.items()}
        text = texts.get(_META, "")
        content = json.loads(text) if text else {}
        form = content.get("format", "")
        if form.startswith("ssrvlad-") and form != FORMAT:
            raise ValueError(f"{path} was made by an earlier format of database: encode it again")
        if form != FORMAT:
            raise ValueError(f"{path} is a table of Lance, but not a database of {FORMAT}")
        if texts.get(_DIGEST) != _digest(text):
            raise ValueError(f"{path} is damaged: the checksum of its settings does not match")
        origins = {}
        for name, entry in texts.items():
            if name.startswith(_ORIGIN):
                stored, key = json.loads(entry), name.removeprefix(_ORIGIN)
                space = stored.pop("label_space")
                origins[key] = Origin(space and LabelSpace.from_dict(space), **stored)
                if origins[key].key != key:
                    raise ValueError(f"{path} is damaged: origin {key} does not match its content")
        columns = tuple(
            Column(**{**column, "shape": tuple(column["shape"])}) for column in content["columns"]
        )
        if content["config"] is None:
            return cls(None, columns, origins)
        try:
            config = SSRVLADConfig.from_dict(content["config"])
        except ValueError as error:
            raise ValueError(f"{path} has settings of another version: {error}") from error
        if config.fingerprint != columns[0].fingerprint:
            raise ValueError(
                f"{path} has fingerprint {columns[0].fingerprint}, made by another version of the "
                f"method; the same settings have {config.fingerprint} here: encode it again"
            )
        return cls(config, columns, origins)


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
