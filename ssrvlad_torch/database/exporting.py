"""Other forms of a database: NumPy, and hloc's HDF5."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np

from ..files import replacing
from .database import Database
from .frames import FrameSet

Format = Literal["npy", "hloc"]

_BYTES_OF_A_GROUP = 1024


def export_database(database: Database, form: Format, file: Path) -> list[Path]:
    """Writes raw descriptors and the names of their frames in another form.

    Args:
        database: what is exported, its frames in order.
        form: ``npy``, an ``(R, D)`` float32 array, and beside it a text file with a frame's id a
            line, a JSON file with the fingerprint and the settings, and an array for each method
            of `Database.beside`; ``hloc``, an HDF5 file with
            a group a frame, named by its id, that holds ``global_descriptor``, ``(D,)`` float32,
            as hloc's ``extract_features`` writes it
            (https://github.com/cvg/Hierarchical-Localization), and a data set for each method of
            `Database.beside`; the settings are its attributes.
        file: where.

    Returns:
        The files written.

    Raises:
        ValueError: the database is damaged, or, for ``npy``, an id has several lines.
        ImportError: the extra ``hloc`` is not installed.
        OSError: the files cannot be written.
    """
    frames, info = database.load(), database.info()
    about = {name: info[name] for name in ("fingerprint", "config", "beside", "label_spaces")}
    if form == "hloc":
        _write_hloc(frames, about, file)
        return [file]
    if broken := [frame for frame in frames.frames if frame.splitlines() != [frame]]:
        raise ValueError(
            f"the form npy holds an id a line, and {len(broken)} of the ids have several, the "
            f"first is {broken[0]!r}"
        )
    texts = {
        ".frames.txt": "".join(f"{frame}\n" for frame in frames.frames),
        ".json": json.dumps(about, indent=1) + "\n",
    }
    if database.fingerprint:
        texts[".fingerprint.txt"] = f"{database.fingerprint}\n"
    arrays = {file.with_name(f"{file.name}.{name}.npy"): v for name, v in frames.beside.items()}
    for each, values in {file: frames.descriptors, **arrays}.items():
        with _written(each) as temporary, temporary.open("wb") as stream:
            np.save(stream, values.numpy())
    beside = {file.with_name(file.name + suffix): text for suffix, text in texts.items()}
    for each, text in beside.items():
        with _written(each) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [file, *arrays, *beside]


@contextmanager
def _written(file: Path) -> Iterator[Path]:
    """As `replacing`; what HDF5 and the system say of a full disk becomes one line."""
    with replacing(file) as temporary:
        try:
            yield temporary
        except (OSError, RuntimeError) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else " ".join(str(error).split())
            raise OSError(f"{file} cannot be written: {reason}") from error


def _write_hloc(frames: FrameSet, about: dict[str, object], file: Path) -> None:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("hloc's files need: pip install ssrvlad-torch[hloc]") from error
    with _written(file) as temporary:
        _see_room(temporary, frames)
        with h5py.File(temporary, "w", libver="latest") as target:
            target.attrs["ssrvlad"] = json.dumps(about)
            arrays = {"global_descriptor": frames.descriptors, **frames.beside}
            for row, frame in enumerate(frames.frames):
                group = target.create_group(frame)
                for name, values in arrays.items():
                    group.create_dataset(name, data=values[row].numpy())


def _see_room(file: Path, frames: FrameSet) -> None:
    """Refuses a disk without room for an HDF5 file: HDF5 ends the process where it runs out."""
    names = sum(len(frame.encode()) for frame in frames.frames)
    arrays = [frames.descriptors, *frames.beside.values()]
    groups = len(arrays) * _BYTES_OF_A_GROUP * (len(frames.frames) + 1)
    expected = 4 * sum(values.numel() for values in arrays) + groups + names
    if shutil.disk_usage(file.parent).free < expected:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with file.open("wb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, expected)
