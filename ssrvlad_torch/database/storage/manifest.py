"""The manifest of a database: which parts count, and what made their descriptors."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from ...config import SSRVLADConfig
from ...files import replacing
from .parts import Part, one_line

FORMAT = "ssrvlad-database"
FORMAT_VERSION = 2
MANIFEST = "manifest.json"
_PART_NAME = re.compile(r"part-\d{6,}\.parquet")


class Manifest(NamedTuple):
    """What a database's folder says of itself.

    Attributes:
        config: the settings of every descriptor; ``labels_as`` is that of the first frames.
        parts: those that count, in the order in which they were added.
        next_part: number of the next part; one that was given is never given again.
    """

    config: SSRVLADConfig
    parts: tuple[Part, ...] = ()
    next_part: int = 0

    def replaced(self, parts: tuple[Part, ...], new: int) -> Manifest:
        """The manifest with other parts, ``new`` of them with new numbers."""
        return self._replace(parts=parts, next_part=self.next_part + new)

    def name(self, new: int = 0) -> str:
        """File name of the next part, or of the one ``new`` after it."""
        return f"part-{self.next_part + new:06d}.parquet"

    @property
    def checksum(self) -> str:
        """SHA-256 of what the manifest says, in hex: another one is another content."""
        return _checksum(self._document())

    def write(self, folder: Path) -> None:
        """Puts it in the place of the one that is there.

        Raises:
            OSError: the disk refused; the one that was there is.
        """
        document = self._document()
        document["checksum"] = _checksum(document)
        with replacing(folder / MANIFEST) as temporary:
            temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")

    def _document(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "fingerprint": self.config.fingerprint,
            "config": self.config.to_dict(),
            "next_part": self.next_part,
            "parts": [part._asdict() for part in self.parts],
        }


def read_manifest(folder: Path, damaged: bool = False) -> Manifest:
    """The manifest of a database.

    Args:
        folder: the database's.
        damaged: take it even if its checksum does not fit, as long as it makes sense.

    Raises:
        ValueError: there is none, it is damaged or of another format, it names a file outside the
            folder, or its settings give other descriptors in this version of the method.
    """
    document = _document_of(folder, damaged)
    try:
        config = SSRVLADConfig.from_dict(document["config"])
    except ValueError as error:
        raise ValueError(f"{folder} has settings of another version: {error}") from error
    if config.fingerprint != document["fingerprint"]:
        raise ValueError(
            f"{folder} has fingerprint {document['fingerprint']}, made by another version of the "
            f"method; the same settings have {config.fingerprint} here: encode it anew"
        )
    parts = tuple(Part(**part) for part in document["parts"])
    return Manifest(config, parts, document["next_part"])


def is_part_name(name: str) -> bool:
    """Whether a file name is that of a part: no other may stand in a manifest."""
    return _PART_NAME.fullmatch(name) is not None


def _document_of(folder: Path, damaged: bool) -> dict[str, Any]:
    file = folder / MANIFEST
    if not file.is_file():
        raise ValueError(f"{folder} is not a database: it has no {MANIFEST}")
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{file} cannot be read: {one_line(error)}") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"{folder} is not a database: {MANIFEST} is of another format")
    if document.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"{folder} has database format {document.get('format_version')}; "
            f"this version reads {FORMAT_VERSION}"
        )
    checksum = document.pop("checksum", None)
    if checksum != _checksum(document) and not damaged:
        raise ValueError(f"{file} is damaged: its checksum does not fit")
    _check(document, file)
    return document


def _check(document: dict[str, Any], file: Path) -> None:
    """Refuses a manifest that this version would not write."""
    wanted = {"fingerprint": str, "config": dict, "next_part": int, "parts": list}
    for name, kind in wanted.items():
        if not isinstance(document.get(name), kind):
            raise ValueError(f"{file} is damaged: it has no {name}")
    for part in document["parts"]:
        if not isinstance(part, dict) or set(part) != set(Part._fields):
            raise ValueError(f"{file} is damaged: it has a part that is none: {part}")
        if not isinstance(part["file"], str) or not is_part_name(part["file"]):
            raise ValueError(f"{file} names a part {part['file']!r}; wanted part-NNNNNN.parquet")


def _checksum(document: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
