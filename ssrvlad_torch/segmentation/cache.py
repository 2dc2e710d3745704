"""A cache of label maps and features, so that no picture is segmented twice; of bounded size."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..datasets.label_files import LabelMap
from ..files import read_npz, replacing

LARGEST = 10 * 10**9
"""Most bytes of a cache."""

Signs = npt.NDArray[np.uint8]


class SegmentedCache:
    """A folder with a file of NumPy for each picture that a network has segmented: its label map
    and its features. ``key`` is that of the network and its preparation, ``features`` that of the
    features, empty for label maps alone. Above `LARGEST` bytes the least recently used entries of
    all networks are removed.
    """

    def __init__(self, folder: Path, key: str, features: str = "") -> None:
        self.folder, self.key, self.features = folder, key, features
        self._size: int | None = None

    def get(self, picture: str) -> tuple[LabelMap, Signs | None] | None:
        """The label map and the features of the picture with this digest; ``None`` if they are
        missing or damaged."""
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
        if self._size is not None:
            self._size += entry.stat().st_size
        if self._size is None or self._size > LARGEST:
            self._size = self._bounded()

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
