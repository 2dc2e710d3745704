"""Frames on disk: found in folders, globs and stacks, with their poses, and read ahead."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

from numpy.lib.format import open_memmap

from ..database.frames import natural_key
from ..files import absolute_folder
from .poses import UNKNOWN, Pose, find_poses

Content = TypeVar("Content")


@dataclass(frozen=True)
class FrameFile:
    """One frame on disk, a label map or an image.

    Attributes:
        sequence, name: the frame's id is ``<sequence>/<name>``.
        path: the file.
        row: which frame of a ``.npy`` stack, ``None`` for a file that holds one.
        pose: from ``poses.csv``, NaN where there is none.
    """

    sequence: str
    name: str
    path: Path
    row: int | None = None
    pose: Pose = UNKNOWN

    @property
    def frame(self) -> str:
        """The frame's id."""
        return f"{self.sequence}/{self.name}"


@dataclass(frozen=True)
class FileKind:
    """Which files are frames.

    Attributes:
        name: what messages call them.
        suffixes: what their names end in, in lower case; all others are passed over.
        stack_rank: rank of a ``.npy`` array that holds a frame a row.
    """

    name: str
    suffixes: tuple[str, ...]
    stack_rank: int


def find_frames(
    kind: FileKind,
    sources: Sequence[str],
    sequence: str | None = None,
    every: int = 1,
    start: int = 0,
) -> list[FrameFile]:
    """The frames of some sources, sorted by sequence and name as a person would.

    Args:
        kind: which files are frames.
        sources: folders, files or globs. The files of a folder are one sequence with the folder's
            name; hidden ones are passed over. A glob that matches no frame stands for the folders
            that it matches. A ``.npy`` stack given by itself is a sequence with the file's name.
        sequence: the name of the sequence in place of the folder's.
        every, start: of each sequence keep frame ``start`` and every ``every``-th after it.

    Raises:
        ValueError: a source holds no frames, two folders give the same frame, or ``every`` or
            ``start`` is out of range.
    """
    if every < 1 or start < 0:
        raise ValueError(f"wanted every >= 1 and start >= 0, got {every} and {start}")
    found: dict[str, FrameFile] = {}
    for source in sources:
        for file in _with_poses(_expand(source, sequence, kind)):
            earlier = found.setdefault(file.frame, file)
            if earlier is not file and not _is_same(earlier, file):
                raise ValueError(
                    f"frame {file.frame!r} is both {earlier.path} and {file.path}; "
                    "give one of them another --sequence"
                )
    by_sequence: dict[str, list[FrameFile]] = {}
    for file in sorted(
        found.values(), key=lambda f: (natural_key(f.sequence), natural_key(f.name))
    ):
        by_sequence.setdefault(file.sequence, []).append(file)
    kept = [file for files in by_sequence.values() for file in files[start::every]]
    if not kept:
        longest = max(map(len, by_sequence.values()))
        raise ValueError(f"no sequence has a frame {start}; the longest has {longest} frames")
    return kept


def read_ahead(
    read: Callable[[FrameFile], Content], files: Iterable[FrameFile], workers: int, ahead: int
) -> Iterator[tuple[FrameFile, Content | ValueError]]:
    """Reads files in order, ``ahead`` of them at a time in memory, by ``workers`` threads.

    Where ``read`` raises a ValueError, the error stands in place of the content.
    """

    def attempt(file: FrameFile) -> Content | ValueError:
        try:
            return read(file)
        except ValueError as error:
            return error

    remaining = iter(files)
    pending: list[tuple[FrameFile, Future[Content | ValueError]]] = []
    with ThreadPoolExecutor(max(1, workers)) as pool:
        while True:
            wanted = islice(remaining, ahead - len(pending))
            pending += [(file, pool.submit(attempt, file)) for file in wanted]
            if not pending:
                return
            file, future = pending.pop(0)
            yield file, future.result()


def is_npy(path: Path) -> bool:
    """Whether a file's name is that of a NumPy array."""
    return path.suffix.lower() == ".npy"


def _expand(source: str, sequence: str | None, kind: FileKind) -> list[FrameFile]:
    path = Path(source)
    matches = [path] if path.exists() else [Path(m) for m in glob.glob(source, recursive=True)]
    if not matches:
        raise ValueError(f"{source} does not exist and matches no file")
    for folders in (False, True):
        places = [match for match in matches if match.is_dir() == folders]
        files = [file for place in places for file in _frames_at(place, sequence, kind)]
        if files:
            return files
    raise ValueError(f"{source} holds no {kind.name}; wanted {', '.join(kind.suffixes)} files")


def _is_same(one: FrameFile, other: FrameFile) -> bool:
    return (one.path.resolve(), one.row) == (other.path.resolve(), other.row)


def _frames_at(place: Path, sequence: str | None, kind: FileKind) -> Iterator[FrameFile]:
    """The frames of a folder or a file. A link to nothing is a frame, refused when it is read."""
    if place.is_dir():
        for entry in place.iterdir():
            if not entry.name.startswith(".") and (entry.is_file() or not entry.exists()):
                yield from _frames(entry, sequence, kind)
    else:
        stack = is_npy(place) and _stack_length(place, kind) is not None
        yield from _frames(place, sequence or (place.stem if stack else None), kind)


def _frames(path: Path, sequence: str | None, kind: FileKind) -> Iterator[FrameFile]:
    if path.suffix.lower() not in kind.suffixes:
        return
    sequence = sequence or absolute_folder(path.parent).name
    length = _stack_length(path, kind) if is_npy(path) else None
    if length is None:
        yield FrameFile(sequence, path.stem, path)
    else:
        for row in range(length):
            yield FrameFile(sequence, f"{path.stem}-{row:06d}", path, row)


def _stack_length(path: Path, kind: FileKind) -> int | None:
    """Frames in a ``.npy`` stack; ``None`` for a single one or a file that cannot be read,
    which is refused by name when its turn comes."""
    try:
        array = open_memmap(path, mode="r")
    except Exception:  # what damaged bytes raise has no bounds
        return None
    return len(array) if array.ndim == kind.stack_rank else None


def _with_poses(files: list[FrameFile]) -> Iterator[FrameFile]:
    """The files with the poses of their ids, of ``<folder>/<name>``, or of their bare names."""
    poses = {folder: find_poses(folder) for folder in {file.path.parent for file in files}}
    for file in files:
        known, folder = poses[file.path.parent], absolute_folder(file.path.parent).name
        ids = (file.frame, f"{folder}/{file.name}", file.name)
        pose = next((known[frame] for frame in ids if frame in known), UNKNOWN)
        yield replace(file, pose=pose)
