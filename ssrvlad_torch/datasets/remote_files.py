"""Frames in the file systems of pyarrow: ``s3://``, ``gs://``, ``hdfs://``, ``file://``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from .frame_file import FrameFile, RemoteFile


def remote_files(folder: str, kind: str, suffixes: Sequence[str]) -> list[FrameFile]:
    """The frames of a folder; their sequence has no name yet.

    Args:
        folder: a URI.
        kind: name of the kind of frames for messages.
        suffixes: suffixes of frame files, in lower case.

    Raises:
        ValueError: pyarrow does not support the URI's scheme, or the folder holds no frames.
        OSError: the folder cannot be read.
    """
    from pyarrow.fs import FileSelector, FileSystem, FileType

    folder = folder.rstrip("/")
    system, root = FileSystem.from_uri(folder)
    found = list[FrameFile]()
    for entry in system.get_file_info(FileSelector(root)):
        path = PurePosixPath(entry.path)
        if entry.type == FileType.Directory or path.name.startswith("."):
            continue
        if path.suffix.lower() in suffixes:
            listed = f"{entry.size} {entry.mtime_ns}"
            found.append(RemoteFile("", path.stem, Path(path), folder=folder, listed=listed))
    if not found:
        raise ValueError(f"{folder} holds no {kind}; expected {', '.join(suffixes)} files")
    return found
