"""Frames in file systems of pyarrow: ``s3://``, ``gs://``, ``hdfs://``, ``file://``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from .frame_file import FrameFile, RemoteFile


def remote_files(folder: str, kind: str, suffixes: Sequence[str]) -> list[FrameFile]:
    """The frames of a folder, of a sequence without a name.

    Args:
        folder: a URI.
        kind: what messages call the frames.
        suffixes: of their names, in lower case.

    Raises:
        ValueError: pyarrow does not know the URI's kind, or the folder holds no frames.
        OSError: the folder cannot be read.
    """
    from pyarrow.fs import FileSelector, FileSystem, FileType

    folder = folder.rstrip("/")
    files, place = FileSystem.from_uri(folder)
    found = list[FrameFile]()
    for entry in files.get_file_info(FileSelector(place)):
        path = PurePosixPath(entry.path)
        if entry.type == FileType.Directory or path.name.startswith("."):
            continue
        if path.suffix.lower() in suffixes:
            listed = f"{entry.size} {entry.mtime_ns}"
            found.append(RemoteFile("", path.stem, Path(path), folder=folder, listed=listed))
    if not found:
        raise ValueError(f"{folder} holds no {kind}; expected {', '.join(suffixes)} files")
    return found
