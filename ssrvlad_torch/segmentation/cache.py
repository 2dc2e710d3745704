"""A cache of label maps on disk, so that no picture is segmented twice; of bounded size."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from PIL import Image

from ..datasets.frame_files import FrameFile
from ..datasets.label_files import LabelMap, read_label_map
from ..files import replacing
from ..taxonomy import LabelSpace

LARGEST = 10 * 10**9
"""Most bytes of a cache."""

_FILLED_TO = 0.9
_WIDEST = 2


class LabelMapCache:
    """A folder of label maps, one PNG for each picture that a network has segmented.

    Args:
        folder: of the whole cache, for all networks.
        key: of the network and its preparation; the name of a folder inside ``folder``.
        space: label space of the label maps.
        largest: most bytes of the whole cache; above it the least recently used are removed.
    """

    def __init__(self, folder: Path, key: str, space: LabelSpace, largest: int = LARGEST) -> None:
        self.folder = folder
        self.key = key
        self.space = space
        self.largest = largest
        self._size: int | None = None

    def get(self, picture: str) -> LabelMap | None:
        """The label map of the picture whose file has this digest; ``None`` if it is missing or
        damaged."""
        entry = self._entry(picture)
        try:
            labels = read_label_map(FrameFile("cache", entry.stem, entry), self.space)
            os.utime(entry)
        except (ValueError, OSError):
            return None
        return labels

    def put(self, picture: str, labels: LabelMap) -> None:
        """Stores a label map, unless its ids do not fit into a PNG.

        Raises:
            OSError: the folder cannot be written.
        """
        if labels.dtype.itemsize > _WIDEST:
            return
        entry = self._entry(picture)
        entry.parent.mkdir(parents=True, exist_ok=True)
        with replacing(entry) as temporary:
            Image.fromarray(labels).save(temporary, format="PNG", compress_level=1)
        if self._size is None:
            self._size = sum(size for _, size, _ in self._entries())
        else:
            self._size += entry.stat().st_size
        if self._size > self.largest:
            self._remove_oldest()

    def _entry(self, picture: str) -> Path:
        return self.folder / self.key / picture[:2] / f"{picture}.png"

    def _entries(self) -> list[tuple[int, int, Path]]:
        """Time of last use, size and path of every label map of the cache."""
        entries = []
        for path in self.folder.glob("*/??/*.png"):
            with suppress(OSError):  # another process has removed it
                status = path.stat()
                entries.append((status.st_mtime_ns, status.st_size, path))
        return entries

    def _remove_oldest(self) -> None:
        entries = sorted(self._entries())
        size = sum(size for _, size, _ in entries)
        for _, part, path in entries:
            if size <= self.largest * _FILLED_TO:
                break
            path.unlink(missing_ok=True)
            size -= part
        self._size = size
