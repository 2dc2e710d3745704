"""Other forms of a database: NumPy, faiss, and hloc's HDF5."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.lib.format import open_memmap

from .database import Database, FrameSet
from .files import replacing

Format = Literal["npy", "faiss", "hloc"]

_BLOCK = 1 << 14


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
    with replacing(names) as temporary:
        temporary.write_text("".join(f"{frame}\n" for frame in frames.frames), encoding="utf-8")
    return [file, names]


def _write_npy(database: Database, file: Path) -> FrameSet:
    with replacing(file) as temporary:
        return database.load_into(lambda shape: open_memmap(temporary, "w+", np.float32, shape))


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
    with replacing(file) as temporary:
        faiss.write_index(index, str(temporary))
    return frames


def _write_hloc(database: Database, file: Path) -> FrameSet:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("hloc's files need: pip install ssrvlad-torch[search]") from error
    frames = database.load()
    with replacing(file) as temporary, h5py.File(temporary, "w", libver="latest") as target:
        for frame, descriptor in zip(frames.frames, frames.descriptors.numpy(), strict=True):
            target.create_group(frame).create_dataset("global_descriptor", data=descriptor)
    return frames


_WRITERS: dict[Format, Callable[[Database, Path], FrameSet]] = {
    "npy": _write_npy,
    "faiss": _write_faiss,
    "hloc": _write_hloc,
}
