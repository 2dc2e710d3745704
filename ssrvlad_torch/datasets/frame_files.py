"""Finding frames in folders, globs, stacks, bags and videos, and reading them ahead."""

import glob
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy.typing as npt
from numpy.lib.format import open_memmap

from ..files import check_regular, is_uri, natural_key, npy_header
from .bags import bag_files, is_bag
from .frame_file import FrameFile, remote_files
from .names import SequenceFolders, absolute, sequence_names
from .pose_tables import FILE_NAME, with_poses_beside, with_poses_of
from .poses import Projection
from .reading import in_order
from .videos import is_video, video_files

__all__ = ["FileKind", "FrameFile", "find_frames", "read_ahead"]

Content = TypeVar("Content")


@dataclass(frozen=True)
class FileKind:
    """Which files are frames, by their suffixes; each row of a ``.npy`` stack is one."""

    name: str
    suffixes: tuple[str, ...]
    is_stack: Callable[[npt.NDArray[Any]], object]

    def files_of(
        self, source: str, topic: str | None, note: Callable[[str], object], other: Counter[str]
    ) -> list[FrameFile]:
        """The frames of a folder, a file, a glob or a URI; none are a ValueError. ``other`` counts
        the suffixes of files that are passed over."""
        if is_uri(source):
            return remote_files(source, self.name, self.suffixes, other)
        if not source:
            raise ValueError("a source is empty; expected a folder, a file, a glob or a URI")
        path = Path(source)
        matches = [path] if path.exists() else [Path(m) for m in glob.glob(source, recursive=True)]
        if not matches:
            raise ValueError(f"{source} does not exist and matches no file")
        matches.sort(key=lambda path: natural_key(str(path)))
        for folders in (False, True):
            paths = (match for match in matches if match.is_dir() == folders)
            if files := [file for path in paths for file in self._at(path, topic, note, other)]:
                return files
        raise ValueError(
            f"{source} holds no {self.name}; expected {', '.join(self.suffixes)} files"
        )

    def _at(
        self, path: Path, topic: str | None, note: Callable[[str], object], other: Counter[str]
    ) -> Iterator[FrameFile]:
        """The frames of a folder, file, bag or video. A broken link is a frame, skipped when read,
        and so is a bag or video that cannot be opened."""
        if self.name == "images" and (is_bag(path) or is_video(path)):
            try:
                of_bag = is_bag(path)
                yield from bag_files(path, topic, note) if of_bag else video_files(path, note)
            except ValueError as error:
                folder, problem = absolute(path), str(error)
                yield FrameFile("", path.stem, path, folder=folder, stamp=0, problem=problem)
            return
        is_folder = path.is_dir()
        home = absolute(path if is_folder else path.parent)
        for entry in path.iterdir() if is_folder else (path,):
            suffix = entry.suffix.lower()
            is_shown = not entry.name.startswith(".") and (entry.is_file() or not entry.exists())
            if suffix not in self.suffixes or (is_folder and not is_shown):
                if is_shown and entry.is_file() and entry.name != FILE_NAME:
                    other[suffix or "without suffix"] += 1
                continue
            length = self._length(entry) if suffix == ".npy" else None
            if length is None or length < 0:
                yield FrameFile("", entry.stem, entry, folder=home, is_torn=length is not None)
                continue
            folder = home if is_folder else absolute(path)
            for row in range(length):
                yield FrameFile("", f"{entry.stem}-{row:06d}", entry, row, folder=folder)

    def _length(self, path: Path) -> int | None:
        """Frames in a ``.npy`` stack; ``None`` for a file of one frame, -1 for a damaged one."""
        try:
            check_regular(path)
            with path.open("rb") as file:
                shape, _, dtype = npy_header(file)
                size = file.tell() + math.prod(shape) * dtype.itemsize
            if len(shape) > 2 and 0 in shape:
                return 0
            if size != path.stat().st_size:
                return -1
            array = open_memmap(path, mode="r")
            return len(array) if self.is_stack(array) else None
        except Exception:  # damaged files raise any exception
            return -1


def find_frames(
    kind: FileKind,
    sources: Sequence[str | Path],
    sequence: str | None = None,
    every: int = 1,
    start: int = 0,
    map_folders: SequenceFolders = (),
    poses: str | None = None,
    topic: str | None = None,
    fps: float | None = None,
    projection: Projection | None = None,
    note: Callable[[str], object] = lambda _: None,
    choose: Callable[[list[FrameFile]], list[FrameFile]] = lambda files: files,
) -> list[FrameFile]:
    """The frames of the sources: folders, whose files are a sequence named by `sequence_names`,
    files, ``.npy`` stacks, videos, bags, globs, or URIs of folders. Sequences have the order of the
    sources; those of a glob, and the frames of a sequence, natural order. A glob that matches no
    frame stands for the folders that it matches.

    Of each sequence frame ``start`` and every ``every``-th after it are kept, of those that ``fps``
    leaves (`at_rate`). ``note`` gets what the user should know, and ``choose`` leaves out files
    that are no frames. No frames, and a file that is two frames, are a ValueError."""
    other = Counter[str]()
    files = [f for source in sources for f in kind.files_of(str(source), topic, note, other)]
    if other:
        counts = ", ".join(f"{count} {suffix}" for suffix, count in other.most_common())
        note(f"files passed over: {counts}; {kind.name} are {', '.join(kind.suffixes)}")
    if files and all(file.problem for file in files):
        raise ValueError(files[0].problem)
    files = choose(files)
    sequences, projection = _sequences(files, sequence, map_folders), projection or Projection()
    if poses:
        sequences = with_poses_of(poses, sequences, projection)
    selected = list[FrameFile]()
    for frames in sequences:
        selected += (frames if fps is None else at_rate(frames, fps))[start::every]
    if not selected:
        longest = max(map(len, sequences))
        raise ValueError(f"no sequence has a frame {start}; the longest has {longest} frames")
    return selected if poses else with_poses_beside(selected, projection, note)


def _sequences(
    files: Sequence[FrameFile], sequence: str | None, map_folders: SequenceFolders
) -> list[list[FrameFile]]:
    """The files of each sequence in natural order; two of one id are a ValueError."""
    folders = dict.fromkeys(file.folder for file in files)
    names = {} if sequence else sequence_names(folders, map_folders)
    frames: dict[str, FrameFile] = {}
    sequences: dict[str, list[FrameFile]] = {}
    for file in files:
        name = sequence or names[file.folder]
        frame = replace(file, sequence=name, is_named=bool(sequence))
        earlier = frames.setdefault(frame.frame, frame)
        if earlier is frame:
            sequences.setdefault(name, []).append(frame)
        elif earlier.row != frame.row or earlier.path.resolve() != frame.path.resolve():
            raise ValueError(
                f"frame {frame.frame!r} is both {earlier.location} and {frame.location}; "
                "give one of them another --sequence"
            )
    return [sorted(files, key=lambda file: natural_key(file.name)) for files in sequences.values()]


def at_rate(sequence: list[FrameFile], fps: float) -> list[FrameFile]:
    """The first frame in each ``1 / fps`` seconds; a ValueError if a frame has no time."""
    chosen = dict[int, FrameFile]()
    for file in sequence:
        if math.isnan(file.stamp):
            raise ValueError(f"fps needs frames of videos or bags; {file.location} has no time")
        # 1e-5: times lie up to half a microsecond beside a multiple of the interval
        chosen.setdefault(math.floor((file.stamp - sequence[0].stamp) * fps + 1e-5 * fps), file)
    return [*chosen.values()]


def read_ahead(
    read: Callable[[FrameFile], Content], files: Iterable[FrameFile], workers: int, ahead: int
) -> Iterator[tuple[FrameFile, Content | ValueError]]:
    """Reads files in ``workers`` threads, at most ``ahead`` of them in memory, and yields them in
    order with their contents, or with the ValueError that ``read`` raised."""

    def attempt(file: FrameFile) -> tuple[FrameFile, Content | ValueError]:
        try:
            return file, read(file)
        except ValueError as error:
            return file, error

    return in_order(attempt, files, workers, ahead)


def found_by(find: Callable[..., list[FrameFile]], *arguments: object) -> list[FrameFile]:
    """The files that ``find`` finds; none where it raises a ValueError."""
    with suppress(ValueError):
        return find(*arguments)
    return []
