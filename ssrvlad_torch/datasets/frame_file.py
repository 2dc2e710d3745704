"""One frame, a label map or an image, on this machine or in the file systems of pyarrow, ``s3://``,
``gs://``, ``hdfs://`` and ``file://``, and the frames that these hold."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy.typing as npt
from numpy.lib.format import open_memmap

from ..files import check_size, npy_bytes, one_line, read_bytes
from .names import absolute, id_of
from .poses import UNKNOWN, Pose


class Skipped(NamedTuple):
    """A frame that was not encoded, and why."""

    frame: str
    reason: str


def _on_disk(file: "FrameFile") -> bytes:
    if file.row is None:
        return read_bytes(file.path)
    return npy_bytes(open_memmap(file.path, mode="r")[file.row])


@dataclass(frozen=True)
class FrameFile:
    """One frame, a label map or an image.

    Attributes:
        sequence, name: the frame's id is ``<sequence>/<name>``.
        row: number of the frame in a ``.npy`` stack or a bag, its time in a video in the units of
            the stream, ``None`` for a file of one frame.
        pose, stamp: pose of the camera, and time in seconds; NaN where unknown.
        is_named: whether the user chose the name of the sequence.
        folder: absolute path of the sequence's folder, or of a stack or bag that is a sequence; of
            a remote file its URI, without secrets and settings.
        has_pose_source: whether a file of poses or the name says the pose. If so, NaN deletes a
            stored pose; if not, a stored pose stays.
        index_is_id: whether the index of a palette, or the first channel, is the id of a label map.
        place: where it is, for messages; by default its path.
        listed: of a remote file, size and modification time when its folder was listed.
        problem: why the frames of a video or bag, for which it stands, cannot be read.
        is_torn: whether it is a ``.npy`` file that cannot be read, perhaps a stack of many frames.
        content: reads the bytes of the file, or of a ``.npy`` file of a row.
    """

    sequence: str
    name: str
    path: Path
    row: int | None = None
    pose: Pose = UNKNOWN
    is_named: bool = False
    folder: str = ""
    stamp: float = float("nan")
    has_pose_source: bool = False
    index_is_id: bool = False
    place: str = ""
    listed: str = ""
    problem: str = ""
    is_torn: bool = False
    content: Callable[["FrameFile"], bytes] = field(default=_on_disk, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.folder:
            folder = self.path.parent if self.row is None else self.path
            object.__setattr__(self, "folder", absolute(folder))

    @property
    def frame(self) -> str:
        """The frame's id."""
        return id_of(self.sequence, self.name)

    @property
    def location(self) -> str:
        """Path or address for messages."""
        return self.place or str(self.path)

    @property
    def readers(self) -> int:
        """Number of frames that one process best reads at once."""
        return 16 if self.listed else 1

    @property
    def state(self) -> str:
        """Size and modification times of the file as text; empty if the file does not exist."""
        if self.listed:
            return self.listed
        try:
            status = self.path.stat()
        except (OSError, ValueError):
            return ""
        return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"

    def signature(self) -> str:
        """A text that changes whenever the frame's source or its reading does."""
        return f"{self.folder}|{self.state}{' index' if self.index_is_id else ''}"

    def read(self) -> bytes:
        """The bytes of the file, or of a ``.npy`` file of a row; a ValueError if damaged."""
        try:
            self.frame.encode()
            if self.problem:
                raise ValueError(self.problem)
            return self.content(self)
        except Exception as error:  # damaged files raise any exception
            raise ValueError(one_line(error)) from error


def frame_in_memory(number: int, array: npt.NDArray[Any]) -> FrameFile:
    """The frame of the sequence ``query`` with a number, a label map or a picture as an array."""
    name, place = f"{number:06d}", f"frame {number}"
    file = FrameFile("query", name, Path(name), folder=str(Path.cwd()), place=place)
    return replace(file, content=partial(_in_memory, array))


def _in_memory(array: npt.NDArray[Any], _: FrameFile) -> bytes:
    return npy_bytes(array)


def _remote(uri: str, file: FrameFile) -> bytes:
    with _connected(uri)[0].open_input_file(str(file.path)) as source:
        check_size(source.size(), file.location)
        content: bytes = source.read()
    return content


@cache
def _connected(uri: str) -> tuple[Any, str]:
    """The file system of a URI, connected once per process, and the path there."""
    from pyarrow.fs import FileSystem

    system, path = FileSystem.from_uri(uri)
    return system, path


def remote_files(
    uri: str, kind: str, suffixes: Sequence[str], passed_over: Counter[str]
) -> list[FrameFile]:
    """The frames in the folder of a URI, files with one of the suffixes, without the name of a
    sequence. ``passed_over`` counts the suffixes of others. An unsupported scheme and no frames are
    a ValueError, a folder that cannot be read is an OSError."""
    from pyarrow.fs import FileSelector, FileType

    system, root = _connected(uri.rstrip("/"))
    scheme, _, address = uri.partition("?")[0].rstrip("/").partition("://")
    authority, slash, below = address.partition("/")
    user, _, host = authority.rpartition("@")
    plain = host if ":" in user else authority  # is stored, so it holds no password
    folder = f"{scheme}://{plain}{slash}{below}"
    files = list[FrameFile]()
    for entry in system.get_file_info(FileSelector(root)):
        path = PurePosixPath(entry.path)
        if entry.type == FileType.Directory or path.name.startswith("."):
            continue
        if path.suffix.lower() in suffixes:
            listed = f"{entry.size} {entry.mtime_ns}"
            file = FrameFile("", path.stem, Path(path), folder=folder, listed=listed)
            place = f"{folder}/{path.name}"
            files.append(replace(file, place=place, content=partial(_remote, uri)))
        else:
            passed_over[path.suffix.lower() or "without suffix"] += 1
    if not files:
        raise ValueError(f"{folder} holds no {kind}; expected {', '.join(suffixes)} files")
    return files
