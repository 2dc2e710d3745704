"""Descriptors of any method, computed elsewhere and stored as hloc does
(https://github.com/cvg/Hierarchical-Localization)."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import View
from ..datasets.dataset import shortened
from ..datasets.names import path_ends
from ..files import check_regular, one_line, requiring
from .channel_methods import VectorMethod

_KEY = "global_descriptor"


class StoredDescriptors(VectorMethod):
    """The vectors of an HDF5 file, compared by their cosine: a group ``<name>`` with the data set
    ``global_descriptor``, ``(D,)`` float, is an image, as hloc and ``ssrvlad db export`` write it.
    `read` comes first. Another file is a ValueError, no extra ``hloc`` an ImportError."""

    needs: frozenset[str] = frozenset()

    def __init__(self, file: str | Path) -> None:
        self.name, self._file = str(file), file
        self._vectors: dict[str, Tensor] = {}
        check_regular(file)
        names: list[str] = []
        with self._opened() as stored:
            stored.visit(names.append)
        groups = (name.rpartition("/") for name in names)
        self._groups = {group for group, _, key in groups if group and key == _KEY}
        if not self._groups:
            raise ValueError(f"{file} has no group with a {_KEY}, as hloc writes them")

    def read(self, frames: Mapping[str, Path | None]) -> None:
        """Reads the descriptors of frames by their ids and files. A group is named by the id, or by
        an end of the path; the longest counts. A frame without one is a ValueError."""
        group_of: dict[str, str] = {}
        for frame, path in frames.items():
            paths = [str(path), str(path.with_suffix(""))] if path else []
            names = [frame, *(end for text in paths for end in path_ends(text))]
            if group := max(self._groups.intersection(names), key=len, default=None):
                group_of[frame] = group
        if lacking := [frame for frame in frames if frame not in group_of]:
            raise ValueError(
                f"{self.name} has no descriptor of {len(lacking)} of {len(frames)} frames: "
                f"{shortened(lacking, most=3)}; it has {shortened(sorted(self._groups), most=2)}"
            )
        [(group, count)] = Counter(group_of.values()).most_common(1)
        if count > 1:
            twins = shortened([frame for frame in frames if group_of[frame] == group], most=3)
            raise ValueError(f"{self.name}: {group} fits {twins}; expected more of the path")
        with self._opened() as stored:
            arrays = {frame: np.asarray(stored[f"{group_of[frame]}/{_KEY}"]) for frame in frames}
        self.shape = (next(iter(arrays.values())).size,)
        for frame, array in arrays.items():
            finite = array.dtype.kind == "f" and np.isfinite(array).all()
            if array.shape != self.shape or not finite:
                raise ValueError(
                    f"{self.name}: {group_of[frame]}/{_KEY} must be {self.shape} finite "
                    f"floats, got {array.shape} {array.dtype}"
                )
            self._vectors[frame] = F.normalize(torch.from_numpy(array.astype(np.float32)), dim=0)

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        return torch.stack([self._vectors[view.frame] for view in views])

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        with requiring("hloc", "stored descriptors need"):
            import h5py
        try:
            with h5py.File(self._file, "r") as stored:
                yield stored
        except (OSError, RuntimeError, TypeError) as error:
            raise ValueError(f"{self.name} is no whole HDF5 file: {one_line(error)}") from error
