"""Other forms of a database: NumPy, faiss, and hloc's HDF5."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Literal

from ..files import replacing
from .database import Database, FrameSet, mapped_array

Format = Literal["npy", "faiss", "hloc"]

_BLOCK = 1 << 14
_BYTES_OF_A_GROUP = 1024


def export_database(database: Database, form: Format, file: Path) -> list[Path]:
    """Writes raw descriptors and the names of their frames in another form.

    Args:
        database: what is exported, its frames in order.
        form: ``npy``, an ``(R, D)`` float32 array, and beside it a text file with a frame's id a
            line; ``faiss``, an ``IndexFlatIP`` of descriptors of length 1, and the same text
            file; ``hloc``, an HDF5 file with a group a frame, named by its id, that holds
            ``global_descriptor``, ``(D,)`` float32, as hloc's ``extract_features`` writes it
            (https://github.com/cvg/Hierarchical-Localization).
        file: where.

    Returns:
        The files written.

    Raises:
        ValueError: a part is missing or damaged.
        ImportError: the extra ``search`` is not installed.
        OSError: the files cannot be written.
    """
    frames = _WRITERS[form](database, file)
    if form == "hloc":
        return [file]
    names = file.with_name(f"{file.name}.frames.txt")
    with _written(names) as temporary:
        temporary.write_text("".join(f"{frame}\n" for frame in frames.frames), encoding="utf-8")
    return [file, names]


@contextmanager
def _written(file: Path) -> Iterator[Path]:
    """As `replacing`; what faiss, HDF5 and the system say of a full disk becomes one line."""
    with replacing(file) as temporary:
        try:
            yield temporary
        except (OSError, RuntimeError) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else " ".join(str(error).split())
            raise OSError(f"{file} cannot be written: {reason}") from error


def _write_npy(database: Database, file: Path) -> FrameSet:
    with _written(file) as temporary:
        return database.load_into(partial(mapped_array, temporary))


def _write_faiss(database: Database, file: Path) -> FrameSet:
    try:
        import faiss
    except ImportError as error:
        raise ImportError("an index of faiss needs: pip install ssrvlad-torch[search]") from error
    frames = database.load()
    index = faiss.IndexFlatIP(database.config.length)
    for first in range(0, len(frames.frames), _BLOCK):
        block = frames.descriptors[first : first + _BLOCK].numpy().copy()
        faiss.normalize_L2(block)
        index.add(block)
    with _written(file) as temporary:
        faiss.write_index(index, str(temporary))
    return frames


def _write_hloc(database: Database, file: Path) -> FrameSet:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("hloc's files need: pip install ssrvlad-torch[search]") from error
    frames = database.load()
    with _written(file) as temporary:
        _see_room(temporary, frames)
        with h5py.File(temporary, "w", libver="latest") as target:
            for frame, descriptor in zip(frames.frames, frames.descriptors.numpy(), strict=True):
                target.create_group(frame).create_dataset("global_descriptor", data=descriptor)
    return frames


def _see_room(file: Path, frames: FrameSet) -> None:
    """Takes the room of an HDF5 file for a moment: HDF5 ends the process where it runs out."""
    names = sum(len(frame.encode()) for frame in frames.frames)
    wanted = 4 * frames.descriptors.numel() + _BYTES_OF_A_GROUP * (len(frames.frames) + 1) + names
    with file.open("wb") as stream:
        os.posix_fallocate(stream.fileno(), 0, wanted)


_WRITERS: dict[Format, Callable[[Database, Path], FrameSet]] = {
    "npy": _write_npy,
    "faiss": _write_faiss,
    "hloc": _write_hloc,
}
