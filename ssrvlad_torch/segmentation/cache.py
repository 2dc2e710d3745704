"""A cache of label maps and features, so that no picture is segmented twice; of bounded size."""

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ..datasets.frame_files import FrameFile
from ..datasets.label_files import LabelMap, read_label_map
from ..files import replacing
from ..stages.features import SHAPE
from ..taxonomy import LabelSpace

LARGEST = 10 * 10**9
"""Most bytes of a cache."""

_CHUNK, _END = b"ftRs", b"\n"
"""A private chunk of a PNG, which other programs ignore and checksums of PNG cover."""

Signs = npt.NDArray[np.uint8]


class SegmentedCache:
    """A folder with a PNG for each picture that a network has segmented: its label map, and its
    features in a chunk of their own.

    In the folder of the whole cache, ``key`` names that of the network and its preparation. Above
    `LARGEST` bytes the least recently used entries are removed. The key of the features is empty
    for label maps alone.
    """

    def __init__(self, folder: Path, key: str, space: LabelSpace, features: str = "") -> None:
        self.folder, self.key, self.space = folder, key, space
        self.features = features.encode()
        self._size: int | None = None

    def get(self, picture: str) -> tuple[LabelMap, Signs | None] | None:
        """The label map and the features that are stored for the picture with this digest; ``None``
        if they are missing or damaged."""
        entry, features = self._entry(picture), None
        try:
            labels = read_label_map(FrameFile("cache", entry.stem, entry), self.space)
            if self.features:
                with Image.open(entry) as image:
                    image.load()
                    chunks = {name: content for name, content, *_ in vars(image)["private_chunks"]}
                key, _, content = chunks.get(_CHUNK, b"").partition(_END)
                if key != self.features:
                    return None
                features = np.frombuffer(content, np.uint8).reshape(SHAPE)
            os.utime(entry)
        except (ValueError, OSError):
            return None
        return labels, features

    def put(self, picture: str, labels: LabelMap, features: Signs | None = None) -> None:
        """Stores a label map and features, unless its ids do not fit into a PNG."""
        if labels.dtype.itemsize > 2:
            return
        entry = self._entry(picture)
        entry.parent.mkdir(parents=True, exist_ok=True)
        chunks = PngInfo()
        if features is not None:
            chunks.add(_CHUNK, self.features + _END + features.tobytes())
        with replacing(entry) as temporary:
            Image.fromarray(labels).save(temporary, format="PNG", compress_level=1, pnginfo=chunks)
        if self._size is not None:
            self._size += entry.stat().st_size
        if self._size is None or self._size > LARGEST:
            self._size = self._bounded()

    def _entry(self, picture: str) -> Path:
        return self.folder / self.key / picture[:2] / f"{picture}.png"

    def _bounded(self) -> int:
        """Removes the least recently used entries of a cache that is too large. Its size then."""
        entries = []
        for path in self.folder.glob("*/??/*.png"):
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
