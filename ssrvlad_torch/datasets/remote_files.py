"""Frames in the file systems of pyarrow: ``s3://``, ``gs://``, ``hdfs://``, ``file://``."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from .frame_file import FrameFile, RemoteFile


def remote_files(uri: str, kind: str, suffixes: Sequence[str]) -> list[FrameFile]:
    """The frames in the folder of a URI, files with one of the suffixes in lower case; their
    sequence has no name yet. A scheme that pyarrow does not support, and no frames, are a
    ValueError that names the kind; a folder that cannot be read is an OSError."""
    from pyarrow.fs import FileSelector, FileSystem, FileType

    system, root = FileSystem.from_uri(uri.rstrip("/"))
    scheme, _, address = uri.partition("?")[0].rstrip("/").partition("://")
    authority, slash, rest = address.partition("/")
    user, _, host = authority.rpartition("@")
    plain = host if ":" in user else authority  # is stored, so it holds no password
    folder = f"{scheme}://{plain}{slash}{rest}"
    found = list[FrameFile]()
    for entry in system.get_file_info(FileSelector(root)):
        path = PurePosixPath(entry.path)
        if entry.type == FileType.Directory or path.name.startswith("."):
            continue
        if path.suffix.lower() in suffixes:
            listed = f"{entry.size} {entry.mtime_ns}"
            file = RemoteFile("", path.stem, Path(path), folder=folder, listed=listed, uri=uri)
            found.append(file)
    if not found:
        raise ValueError(f"{folder} holds no {kind}; expected {', '.join(suffixes)} files")
    return found
