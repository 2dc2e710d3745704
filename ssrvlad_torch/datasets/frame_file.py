"""One frame on disk or elsewhere: a label map or an image, its bytes, and what tells it apart."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from numpy.lib.format import open_memmap, write_array

from ..files import one_line
from ..untrusted import check_size, read_bytes
from .names import absolute
from .poses import UNKNOWN, Pose

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem


@dataclass(frozen=True)
class FrameFile:
    """One frame on disk, a label map or an image.

    Attributes:
        sequence, name: the frame's id is ``<sequence>/<name>``.
        path: the file.
        row: which frame of a ``.npy`` stack, ``None`` for a file that holds one.
        pose: where it was taken, NaN where unknown.
        named: whether the user chose the name of the sequence.
        folder: absolute path of the sequence's folder, or of a stack without its suffix.
        stamp: when it was taken, in seconds, NaN where unknown.
    """

    sequence: str
    name: str
    path: Path
    row: int | None = None
    pose: Pose = UNKNOWN
    named: bool = False
    folder: str = ""
    stamp: float = float("nan")

    def __post_init__(self) -> None:
        if not self.folder:
            place = self.path.parent if self.row is None else self.path.with_suffix("")
            object.__setattr__(self, "folder", absolute(place))

    readers: ClassVar[int] = 1
    """How many of them are best read at once by one process."""

    @property
    def frame(self) -> str:
        """The frame's id."""
        return f"{self.sequence}/{self.name}"

    @property
    def place(self) -> str:
        """Where it is, for messages."""
        return str(self.path)

    @property
    def local_folder(self) -> Path | None:
        """The folder of this machine that the file is in, if it is in one."""
        return self.path.parent

    @property
    def state(self) -> str:
        """Size and times of the last changes of the file, as text; empty if there is no such
        file."""
        try:
            status = self.path.stat()
        except (OSError, ValueError):
            return ""
        return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"

    def signature(self) -> str:
        """A text that changes whenever the frame's source does: its folder and state."""
        return f"{self.folder}|{self.state}"

    def read(self) -> bytes:
        """The bytes of the file; of a row of a stack, the ``.npy`` file that it would be alone.

        Raises:
            ValueError: the file is missing or cannot be read, or has a name that is no text.
        """
        try:
            self.frame.encode()
            return self._content()
        except Exception as error:  # what damaged bytes raise has no bounds
            raise ValueError(one_line(error)) from error

    def _content(self) -> bytes:
        if self.row is None:
            return read_bytes(self.path)
        content = io.BytesIO()
        write_array(content, open_memmap(self.path, mode="r")[self.row], allow_pickle=False)
        return content.getvalue()


@dataclass(frozen=True)
class RemoteFile(FrameFile):
    """One frame that is no file of this machine.

    Attributes:
        path: its path in the file system.
        folder: URI of its folder.
        listed: its size and time in the listing of its folder.
    """

    listed: str = ""

    readers: ClassVar[int] = 16

    @property
    def place(self) -> str:
        """Where it is, for messages."""
        return f"{self.folder}/{self.path.name}"

    @property
    def local_folder(self) -> Path | None:
        """None."""
        return None

    @property
    def state(self) -> str:
        """As it was when its folder was listed."""
        return self.listed

    def _content(self) -> bytes:
        with _file_system(self.folder).open_input_file(str(self.path)) as source:
            check_size(source.size(), self.place)
            content: bytes = source.read()
        return content


@cache
def _file_system(folder: str) -> FileSystem:
    """One connection of this process for all files of a folder."""
    from pyarrow.fs import FileSystem

    return FileSystem.from_uri(folder)[0]
