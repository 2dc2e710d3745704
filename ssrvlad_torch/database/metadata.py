"""The metadata of a database: settings, extra descriptors, and the origins of label maps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..config import SSRVLADConfig
from ..taxonomy import LabelSpace

FORMAT = "ssrvlad-database-5"

_META, _DIGEST, _ORIGIN = "ssrvlad", "ssrvlad-digest", "origin:"


class ExtraDescriptor(NamedTuple):
    """A further descriptor of every frame, made from its picture.

    Attributes:
        name: name of its method, and of its column.
        width: its length, in numbers or bytes.
        fingerprint: descriptors are comparable only if their fingerprints are equal.
        cells: for signs, eight in a uint8: columns and rows of cells, and bytes of each; empty for
            float32 numbers.
    """

    name: str
    width: int
    fingerprint: str
    cells: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the descriptor in memory."""
        return self.cells or (self.width,)


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
    """A table's metadata: settings (or ``None``), extra descriptors, and origins by their keys."""

    config: SSRVLADConfig | None
    extra: tuple[ExtraDescriptor, ...]
    origins: dict[str, Origin]

    @staticmethod
    def to_dict(
        config: SSRVLADConfig | None, extra: Sequence[ExtraDescriptor] = ()
    ) -> dict[str, str]:
        """The entries of a new table, which has no origins."""
        text = json.dumps(
            {
                "format": FORMAT,
                "fingerprint": config.fingerprint if config else "",
                "config": config and config.to_dict(),
                "beside": [each._asdict() for each in extra],
            }
        )
        return {_META: text, _DIGEST: _digest(text)}

    @classmethod
    def of(cls, entries: Mapping[bytes, bytes], path: str) -> Meta:
        """The metadata in the entries of the table at ``path``. A table that is no database of this
        format, is damaged, or was made by another version of the method is a ValueError."""
        texts = {key.decode(): value.decode() for key, value in entries.items()}
        text = texts.get(_META, "")
        form = json.loads(text).get("format", "") if text else ""
        if form.startswith("ssrvlad-") and form != FORMAT:
            raise ValueError(f"{path} was made by an earlier format of database: encode it again")
        if form != FORMAT:
            raise ValueError(f"{path} is a table of Lance, but not a database of {FORMAT}")
        if texts.get(_DIGEST) != _digest(text):
            raise ValueError(f"{path} is damaged: the checksum of its settings does not match")
        origins = {}
        for name, entry in texts.items():
            if name.startswith(_ORIGIN):
                content, key = json.loads(entry), name.removeprefix(_ORIGIN)
                space = content.pop("label_space")
                origins[key] = Origin(space and LabelSpace.from_dict(space), **content)
                if origins[key].key != key:
                    raise ValueError(f"{path} is damaged: origin {key} does not match its content")
        content = json.loads(text)
        extra = tuple(
            ExtraDescriptor(**{**each, "cells": tuple(each.get("cells", ()))})
            for each in content.get("beside", ())
        )
        if content["config"] is None:
            return cls(None, extra, origins)
        try:
            config = SSRVLADConfig.from_dict(content["config"])
        except ValueError as error:
            raise ValueError(f"{path} has settings of another version: {error}") from error
        if config.fingerprint != content["fingerprint"]:
            raise ValueError(
                f"{path} has fingerprint {content['fingerprint']}, made by another version of the "
                f"method; the same settings have {config.fingerprint} here: encode it again"
            )
        return cls(config, extra, origins)


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
