"""Sums of the descriptors of each sequence, beside the coarse index: of these, the means are made
that drives lose, see `recognition.standardise`.

Each data file of the table has its own, of the rows that it held when it was indexed. Where rows
were removed since, the sums are made again from the others.
"""

import errno
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from numpy.lib import format as npy
from torch import Tensor

from ..channels import Column
from ..files import flush, path_within, read_npz, replacing

Array = npt.NDArray[Any]

_IN_A_BYTE = 255
"""Most bits whose sum is a byte."""


def sums(descriptors: Tensor) -> tuple[npt.NDArray[np.float64], int]:
    """The sum of descriptors, and how many count in it: ``(D,)`` of vectors ``(N, D)`` at length 1,
    without zeros; ``(columns, bits)`` of signs ``(N, columns, ...)`` uint8 as 1 and -1."""
    if descriptors.dtype != torch.uint8:
        units = F.normalize(descriptors.float(), dim=1)
        return units.sum(0, dtype=torch.double).numpy(), int(units.any(1).sum())
    signs = descriptors.flatten(2).numpy()
    ones = np.zeros((signs.shape[1], 8 * signs.shape[2]))
    for first in range(0, len(signs), _IN_A_BYTE):
        bits = np.unpackbits(signs[first : first + _IN_A_BYTE], axis=2, bitorder="little")
        ones += bits.sum(0, dtype=np.uint8)
    return 2 * ones - len(signs), len(signs)


class Sums(NamedTuple):
    """Of the rows of one data file.

    Attributes:
        stem: of its files.
        numbers: of the sequences, by their names.
        frames: ``(S,)`` of each sequence.
        counted: by channel, ``(S,)`` frames that are not empty.
    """

    stem: Path
    numbers: dict[str, int]
    frames: Array
    counted: Mapping[str, Array]

    @classmethod
    def read(cls, stem: Path, columns: Sequence[Column]) -> Self | None:
        """Those of a data file; ``None`` unless all are there, whole."""
        try:
            about = read_npz(stem.with_name(f"{stem.name}.sums.npz"))
            names, frames = about["sequences"].tolist(), about["frames"]
            counted = {column.name: about[column.name] for column in columns}
            shapes = [np.load(_file(stem, column), mmap_mode="r").shape for column in columns]
        except (OSError, ValueError, KeyError) as error:
            refuse_many_files(error)
            return None
        if shapes != [(len(names), *_shape(column)) for column in columns]:
            return None
        return cls(stem, {name: number for number, name in enumerate(names)}, frames, counted)

    def of(self, sequence: str, column: Column) -> tuple[Array, int]:
        """The sum ``(*shape of the mean)`` of a sequence, and how many frames count in it."""
        number = self.numbers[sequence]
        total = np.load(_file(self.stem, column), mmap_mode="r")[number]  # files are not kept open
        return np.array(total), int(self.counted[column.name][number])


def refuse_many_files(error: Exception) -> None:
    """Raises a ValueError if an error is that too many files are open."""
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        raise ValueError(
            "the index is in more files than this process may open (ulimit -n); ssrvlad db "
            "compact joins them"
        ) from error


@contextmanager
def writing_sums(
    stem: Path, columns: Sequence[Column], sequences: Sequence[str]
) -> Iterator[Callable[[Mapping[str, Tensor]], None]]:
    """Writes the sums of a data file of which all rows are in some sequences, "" for removed rows.
    The function that it gives adds the next rows by channel."""
    names, of = np.unique(np.array(sequences, dtype=str), return_inverse=True)
    totals: dict[str, np.memmap[Any, Any]] = {}
    frames = {column.name: np.zeros(len(names), np.int64) for column in columns}
    done = 0

    def add(rows: Mapping[str, Tensor]) -> None:
        nonlocal done
        here = of[done : done + len(next(iter(rows.values())))]
        done += len(here)
        for number in np.unique(here):
            for name, values in rows.items():
                total, counted = sums(values[torch.from_numpy(here == number)])
                totals[name][number] += total
                frames[name][number] += counted

    with ExitStack() as stack:
        for column in columns:
            part = stack.enter_context(replacing(_file(stem, column)))
            shape = len(names), *_shape(column)
            with part.open("wb") as stream:
                about = {"shape": shape, "fortran_order": False, "descr": "<f4"}
                npy.write_array_header_1_0(stream, about)
                for _ in names:
                    stream.write(bytes(4 * math.prod(shape[1:])))
            flush(part)  # a full disk is an error here, and none where the file is mapped
            totals[column.name] = np.load(part, mmap_mode="r+")
        yield add
        for each in totals.values():
            each.flush()
    arrays: dict[str, Any] = {"sequences": names, "frames": np.bincount(of), **frames}
    path = path_within(stem.parent, f"{stem.name}.sums.npz", ".+")
    with replacing(path) as part, part.open("wb") as stream:
        np.savez(stream, **arrays)


def mean_of(parts: Iterable[tuple[Array, int]], column: Column) -> Tensor:
    """The mean ``(*shape of the mean)`` float32 by sums of descriptors and how many count."""
    total, counted = np.zeros(_shape(column)), 0
    for each, count in parts:
        total += each
        counted += count
    return torch.from_numpy(total / max(1, counted)).float()


def _shape(column: Column) -> tuple[int, ...]:
    return sums(torch.from_numpy(column.zeros(0)))[0].shape


def _file(stem: Path, column: Column) -> Path:
    return path_within(stem.parent, f"{stem.name}.sums.{column.name}.npy", ".+")
