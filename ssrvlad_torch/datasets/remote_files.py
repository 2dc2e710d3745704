"""Label maps that lie where pyarrow can reach them: ``s3://``, ``gs://``, ``hdfs://``, ``file://``."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath

from pyarrow.fs import FileInfo, FileSelector, FileSystem, FileType

from ..database.frames import natural_key
from .frame_files import FrameFile
from .label_files import SUFFIXES


@dataclass(frozen=True)
class RemoteFile(FrameFile):
    """One frame that is no file of this machine.

    Attributes:
        path: its path in the file system.
        folder: URI of the folder that it is in.
        stamp: a number that changes whenever the file does: of its size and time.
    """

    folder: str = ""
    stamp: int = 0

    @property
    def uri(self) -> str:
        """Where it is, for messages."""
        return f"{self.folder.rstrip('/')}/{self.path.name}"

    @contextmanager
    def fetched(self) -> Iterator[FrameFile]:
        """The same frame as a file of this machine, for as long as it is needed.

        Raises:
            OSError: it cannot be had.
        """
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder) / self.path.name
            with _file_system(self.folder).open_input_file(str(self.path)) as source:
                local.write_bytes(source.read())
            yield FrameFile(self.sequence, self.name, local, pose=self.pose)


def is_uri(source: str) -> bool:
    """Whether a source is a URI, not a path or a glob."""
    return "://" in source


def find_remote_files(
    folders: Sequence[str], sequence: str | None = None, every: int = 1, start: int = 0
) -> list[FrameFile]:
    """The label maps of some folders, by sequence and name as a person would sort them.

    A ``.npy`` file is one label map here, not a stack, and there are no poses.

    Args:
        folders: URIs; each is one sequence with the folder's name.
        sequence: the name of the sequence in place of the folder's.
        every, start: of each sequence keep frame ``start`` and every ``every``-th after it.

    Raises:
        ValueError: a URI is of no kind that pyarrow knows, a folder holds no label maps, or two
            give the same frame.
        OSError: a folder cannot be read.
    """
    found: dict[str, FrameFile] = {}
    for folder in folders:
        files = sorted(_label_maps(folder, sequence), key=lambda file: natural_key(file.name))
        if not files[start::every]:
            raise ValueError(f"{folder} holds no label maps; wanted {', '.join(SUFFIXES)} files")
        for file in files[start::every]:
            if found.setdefault(file.frame, file) is not file:
                raise ValueError(f"frame {file.frame!r} of {folder} is there twice")
    return sorted(found.values(), key=lambda file: natural_key(file.sequence))


def _label_maps(folder: str, sequence: str | None) -> Iterator[RemoteFile]:
    files, place = FileSystem.from_uri(folder)
    for entry in files.get_file_info(FileSelector(place)):
        path = PurePosixPath(entry.path)
        if entry.type == FileType.Directory or path.name.startswith("."):
            continue
        if path.suffix.lower() in SUFFIXES:
            named = sequence or path.parent.name
            yield RemoteFile(named, path.stem, Path(path), folder=folder, stamp=_stamp(entry))


def _stamp(entry: FileInfo) -> int:
    text = f"{entry.size} {entry.mtime_ns}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big", signed=True) or 1


@cache
def _file_system(folder: str) -> FileSystem:
    """One connection of this process for all files of a folder."""
    return FileSystem.from_uri(folder)[0]
