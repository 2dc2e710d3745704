"""Export of a database to NumPy or to hloc's HDF5."""

import errno
import json
import os
import posixpath
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ..channels import CHANNELS
from ..files import replacing, requiring
from .database import Database
from .frames import FrameSet

Format = Literal["npy", "hloc"]

_FINGERPRINT, _POSES = ".fingerprint.txt", ".poses.npy"
_GROUP_BYTES = 1024


def export_database(database: Database, form: Format, file: Path) -> list[Path]:
    """Writes raw descriptors and frame ids, in natural order, to files of another format, which are
    returned, ``file`` first.

    ``npy`` is an ``(R, D)`` float32 array, a text file with one frame id per line, a JSON file with
    fingerprint and settings, an array for each further channel, with its fingerprint in a text
    file, and if a pose is known ``(R, 3)`` float64 of x, y and heading; those of an earlier export
    that are not written again are deleted. ``hloc`` is an HDF5 file with one group per frame, named
    by its id: ``global_descriptor``, ``(D,)`` float32, as hloc's ``extract_features`` writes it
    (https://github.com/cvg/Hierarchical-Localization), and a data set for each further channel.
    Fingerprint and settings are in the file's attribute ``ssrvlad``. A damaged database, and for
    ``npy`` an id of several lines, are a ValueError; without the extra ``hloc`` it is an
    ImportError."""
    frames, info = database.load(), database.info()
    about = {name: info[name] for name in ("fingerprint", "config", "channels", "label_spaces")}
    if form == "hloc":
        _write_hloc(frames, about, file)
        return [file]
    if broken := [frame for frame in frames.frames if frame.splitlines() != [frame]]:
        raise ValueError(
            f"the form npy holds one id per line, and {len(broken)} of the ids have several "
            f"lines, the first is {broken[0]!r}"
        )
    first, *further = database.columns
    columns = {"": first, **{f".{column.name}.npy": column for column in further}}
    arrays: dict[str, npt.NDArray[Any]] = {
        end: frames.channels[column.name].numpy() for end, column in columns.items()
    }
    if np.isfinite(frames.poses).any():
        arrays[_POSES] = frames.poses
    texts = {
        ".frames.txt": "".join(f"{frame}\n" for frame in frames.frames),
        ".json": json.dumps(about, indent=1) + "\n",
    }
    for end, column in columns.items():
        if column.fingerprint:
            texts[end + _FINGERPRINT] = f"{column.fingerprint}\n"
    with ExitStack() as stack:  # all files are whole before the first replaces an earlier one
        for end, array in arrays.items():
            target = stack.enter_context(replacing(file.with_name(file.name + end)))
            with target.open("wb") as stream:
                np.save(stream, array)
        for end, text in texts.items():
            target = stack.enter_context(replacing(file.with_name(file.name + end)))
            target.write_text(text, encoding="utf-8", newline="\n")
    for end in ("", _POSES, *(f".{name}.npy" for name in CHANNELS)):
        for earlier in {end, end + _FINGERPRINT} - {*arrays, *texts}:
            file.with_name(file.name + earlier).unlink(missing_ok=True)
    return [file.with_name(file.name + end) for end in (*arrays, *texts)]


def _write_hloc(frames: FrameSet, about: dict[str, object], file: Path) -> None:
    with requiring("hloc", "hloc's files need"):
        import h5py
    (first, *_), arrays = frames.channels, dict(frames.channels)
    arrays = {"global_descriptor": arrays.pop(first), **arrays}
    for frame in frames.frames:
        plain = "\0" not in frame and not frame.startswith("/")
        if not plain or posixpath.normpath(frame) != frame or arrays.keys() & frame.split("/"):
            raise ValueError(f"HDF5 cannot have a group {frame!r}; {file} needs one for each frame")
    groups = len(arrays) * _GROUP_BYTES * (len(frames.frames) + 1)
    names = sum(len(frame.encode()) for frame in frames.frames)
    expected = sum(values.nbytes for values in arrays.values()) + groups + names
    with replacing(file) as temporary:
        if shutil.disk_usage(temporary.parent).free < expected:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        with temporary.open("wb") as stream:  # HDF5 aborts the process on a full disk
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(stream.fileno(), 0, expected)
        with h5py.File(temporary, "w", libver="latest") as target:
            target.attrs["ssrvlad"] = json.dumps(about)
            for row, frame in enumerate(frames.frames):
                group = target.require_group(frame)
                for name, values in arrays.items():
                    group.create_dataset(name, data=values[row].numpy())
