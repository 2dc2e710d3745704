"""What is kept of networks: label maps and features of pictures, in a cache of bounded size, and
the identity of networks that were opened, as long as their files stay as they are."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..config import package_version
from ..datasets.label_files import LabelMap
from ..datasets.names import absolute
from ..files import parse_json, path_within, read_npz, read_yaml, replacing

LARGEST, UNSEEN = 10 * 10**9, 0.01
"""Most bytes of a cache, and the part of them that is stored before the folder is measured anew:
other processes store there too."""

Signs = npt.NDArray[np.uint8]


class SegmentedCache:
    """A folder with a file of NumPy for each picture that a network has segmented. ``key`` is that
    of the network, ``features`` that of the features, empty for label maps alone. Above `LARGEST`
    bytes the least recently used entries are removed."""

    def __init__(self, folder: Path, key: str, features: str = "") -> None:
        self.folder, self.key, self.features = folder, key, features
        self._size = self._measured_above = 0.0

    def get(self, picture: str) -> tuple[LabelMap, Signs | None] | None:
        """The label map and features of a picture by its digest; ``None`` if missing or damaged."""
        entry = self._entry(picture)
        try:
            arrays = read_npz(entry)
            labels, key = arrays["labels"], str(arrays["key"])
            os.utime(entry)
        except (ValueError, OSError, KeyError):
            return None
        if not self.features:
            return labels, None
        return (labels, arrays["features"]) if key == self.features else None

    def put(self, picture: str, labels: LabelMap, features: Signs | None = None) -> None:
        """Stores a label map and features."""
        entry = self._entry(picture)
        entry.parent.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = {"labels": labels, "key": self.features}
        if features is not None:
            arrays["features"] = features
        with replacing(entry) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)
        self._size += entry.stat().st_size
        if self._size > min(self._measured_above, LARGEST):
            self._size = self._bounded()
            self._measured_above = self._size + UNSEEN * LARGEST

    def _entry(self, picture: str) -> Path:
        return self.folder / self.key / picture[:2] / f"{picture}.npz"

    def _bounded(self) -> int:
        """Removes the least recently used entries of a cache that is too large. Its size then."""
        entries = []
        for path in self.folder.glob("*/??/*.*"):
            with suppress(OSError):  # another process has removed it
                status = path.stat()
                entries.append((status.st_mtime_ns, status.st_size, path))
        size = sum(size for _, size, _ in entries)
        left = size if size <= LARGEST else 0.9 * LARGEST
        for _, length, path in sorted(entries):
            if size <= left:
                break
            path.unlink(missing_ok=True)
            size -= length
        return size


YAML = (".yaml", ".yml")
_FILE = "networks.json"


def state_of(name: str) -> str:
    """A text that changes with the files of a network, an ONNX file or a YAML file that names one:
    with the names, sizes and times of all files beside them. Empty for other networks."""
    path = Path(name)
    paths = [path]
    try:
        if path.suffix.lower() in YAML:
            document = read_yaml(path)
            paths += [path_within(path.parent, document["network"])]
            with suppress(ValueError, KeyError):  # it may be the name of a label space
                paths += [path_within(path.parent, document["labels_as"])]
        if not any(path.suffix.lower() == ".onnx" and path.is_file() for path in paths):
            return ""
        folders = sorted({path.parent for path in paths if path.is_file()})
        entries = sorted(entry for folder in folders for entry in folder.iterdir())
        stats = [(str(entry), entry.stat()) for entry in entries if entry.is_file()]
    except (ValueError, OSError, KeyError, TypeError):
        return ""
    state = [(file, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for file, s in stats]
    return hashlib.sha256(repr([package_version(), state]).encode()).hexdigest()


def known_key(name: str, cache: Path) -> str:
    """The key of the segmenter of a network whose files are as they were remembered, else empty."""
    state, key = _entries(cache).get(absolute(Path(name)), ("", ""))
    return str(key) if state and state == state_of(name) else ""


def remember(name: str, state: str, key: str, cache: Path) -> None:
    """Stores the key of a segmenter, and the state of its files before it was opened."""
    content = {**_entries(cache), name: [state, key]}
    with suppress(OSError):  # it is asked again the next time
        cache.mkdir(parents=True, exist_ok=True)
        with replacing(cache / _FILE) as file:
            file.write_text(json.dumps(content))


def _entries(cache: Path) -> dict[str, Any]:
    try:
        entries: dict[str, Any] = parse_json((cache / _FILE).read_text("utf-8"), _FILE)
    except (ValueError, OSError):
        return {}
    return entries
