"""Encoding of files whose names arrive one by one."""

import functools
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from ..database.database import Database
from ..datasets.frame_file import FrameFile
from ..datasets.names import absolute, sequence_names
from ..datasets.pose_tables import PoseTable, with_pose
from ..datasets.poses import Projection
from ..segmentation.segmenter import Segmenter
from .encoder import Describer, encode
from .plan import check_folder
from .results import Encoded, Skipped
from .source import pose_in


def encode_names(
    describer: Describer,
    names: Iterable[str],
    sequence: str | None = None,
    segmenter: Segmenter | None = None,
    database: Database | None = None,
    left_out: Collection[str] = (),
) -> Iterator[Encoded | Skipped]:
    """Encodes files one by one, each as soon as the line with its name arrives; empty lines and the
    frames that are ``left_out`` are ignored. A ``poses.csv`` in or beside a file's folder is read
    once. The sequence is named by the folder, as in the database. A segmenter labels images; else
    the files are label maps."""
    records, folders = (database.known(), database.folders()) if database else ({}, set())
    projection = Projection(functools.partial(pose_in, database))
    find = functools.cache(lambda folder: PoseTable.of_folder(folder, projection))

    @functools.cache
    def sequence_of(folder: str) -> str:
        name = sequence or sequence_names([folder], folders)[folder]
        folders.add((folder, name))
        return name

    for line in names:
        if not line.strip():
            continue
        path = Path(line.rstrip("\r\n"))
        frame = str(path)
        try:
            file = FrameFile(sequence_of(absolute(path.parent)), path.stem, path)
            if (frame := file.frame) in records:
                check_folder(file, records[frame])
            if frame in left_out:
                continue
            posed = [with_pose(file, find)]
        except ValueError as error:
            yield Skipped(frame, str(error))
            continue
        yield from encode(describer, posed, 1, segmenter)
