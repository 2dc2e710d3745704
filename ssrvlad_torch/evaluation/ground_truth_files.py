"""Ground truth from files: pairs of frames, a 0/1 matrix, or VPR-Bench's rows of numbers."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from ..datasets.names import IMAGE_SUFFIXES as SUFFIXES
from ..datasets.names import name_of
from ..files import check_regular, npy_header, one_line, parse_npy, read_bytes, read_json
from .curves import Rows

Matrix = npt.NDArray[Any]
Pairs = dict[str, list[str]]
"""Ids of the true matches of each query, by the query's id."""
Numbers = list[tuple[int, list[int]]]
"""VPR-Bench's rows: the number of each query, and those of its true matches."""
PartialTruth = list[Rows | None]
"""True matches of each query; ``None`` for a query that the ground truth does not cover."""
Frames = Sequence[str] | Mapping[str, str]
"""Frame ids ``<sequence>/<name>`` in order; a mapping also gives the full path of each file."""


def from_file(
    path: str | Path, queries: Frames, references: Frames
) -> tuple[PartialTruth, list[str]]:
    """True matches from a file, whose form is recognised by its suffix and content; and the entries
    of a file of pairs that name none of the queries.

    | file | holds |
    |---|---|
    | ``.json`` | ``{"<query>": ["<reference>", ...]}`` |
    | ``.json`` | VPR-Bench's ``ground_truth_new.npy``, converted: ``[[0, [0, 1, ...]], ...]`` |
    | ``.csv`` | a first line ``query,reference`` and a line for each pair |
    | ``.npy`` | a 0/1 matrix ``(Q, R)`` |

    An entry names a frame by its id, or by the only path that ends so, with or without the suffix
    of the file. A query that no entry names has an unknown truth; one without a true match needs an
    empty list, or in CSV a line with an empty reference. A matrix and VPR-Bench's rows count frames
    from 0 in the order of ``queries`` and ``references``. A file that cannot be read, has another
    form or size, names an unknown reference, has no entry for any of the queries, or has an entry
    that fits several frames is a ValueError; so is a pickle, with how to convert it."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        expected = ", ".join(_READERS)
        raise ValueError(f"cannot read the ground truth {path}: expected a file in {expected}")
    try:
        check_regular(path)
        content = _READERS[suffix](path)
    except Exception as error:  # decoders raise any exception on damaged bytes
        raise ValueError(f"cannot read the ground truth {path}: {one_line(error)}") from error
    try:
        if isinstance(content, dict):
            return _from_pairs(content, queries, references)
        if isinstance(content, list):
            return _from_vpr_bench(content, len(queries), len(references)), []
        return _from_matrix(content, len(queries), len(references)), []
    except ValueError as error:
        raise ValueError(f"ground truth {path} {error}") from error


def known_matches(truth: PartialTruth) -> tuple[list[int], list[Rows]]:
    """Rows of the queries that the ground truth covers, and their true matches."""
    covered = {query: matches for query, matches in enumerate(truth) if matches is not None}
    return list(covered), list(covered.values())


def _read_json(path: Path) -> Pairs | Numbers:
    content = read_json(path)
    if isinstance(content, list) and content and all(map(_is_numbers, content)):
        return content
    lists: Iterable[object] = content.values() if isinstance(content, dict) else [None]
    if all(isinstance(ids, list) and all(isinstance(id_, str) for id_ in ids) for ids in lists):
        pairs: Pairs = content
        return pairs
    raise ValueError(
        'expected {"<query id>": ["<reference id>", ...], ...}, or [[0, [0, 1, ...]], ...] of '
        "whole numbers"
    )


def _read_csv(path: Path) -> Pairs:
    """References by query; an empty reference stands for a query without a true match."""
    pairs: Pairs = {}
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = csv.DictReader(file, restval="", skipinitialspace=True)
        if not {"query", "reference"} <= set(lines.fieldnames or ()):
            raise ValueError("expected a first line query,reference")
        for row in lines:
            if any(row.get(None, ())):
                raise ValueError(f"line {lines.line_num}: more cells than columns")
            pairs.setdefault(row["query"], []).extend([row["reference"]] * bool(row["reference"]))
    return pairs


def _read_npy(path: Path) -> Matrix:
    with path.open("rb") as file:
        if npy_header(file)[2].hasobject:
            rows = f"np.load({str(path)!r}, allow_pickle=True)"
            numbers = f"[[int(query), [*map(int, matches)]] for query, matches in {rows}]"
            program = f"import json, numpy as np; print(json.dumps({numbers}))"
            raise ValueError(
                "it is a pickle, which can run any code; if you trust it: "
                f'python -c "{program}" > "{path.with_suffix(".json")}"'
            )
    return parse_npy(read_bytes(path))


_READERS = {".json": _read_json, ".csv": _read_csv, ".npy": _read_npy}


def _is_numbers(row: object) -> bool:
    """Whether a row is ``[query, [reference, ...]]``, all whole numbers."""
    match row:
        case [query, list(matches)]:
            return all(type(number) is int for number in (query, *matches))
    return False


def _from_pairs(
    pairs: Pairs, queries: Frames, references: Frames
) -> tuple[PartialTruth, list[str]]:
    find_query, find_reference = _finder(queries), _finder(references)
    row = {frame: number for number, frame in enumerate(references)}
    matches: dict[str, list[int]] = {}
    unmatched = list[str]()
    for query_entry, reference_entries in pairs.items():
        if (query := find_query(query_entry)) is None:
            unmatched.append(query_entry)
            continue
        rows = matches.setdefault(query, [])
        for entry in reference_entries:
            if (reference := entry if entry in row else find_reference(entry)) is None:
                raise ValueError(f"names reference {entry!r}, which is not in the database")
            rows.append(row[reference])
    if queries and not matches:
        first = next(iter(queries))
        raise ValueError(f"has an entry for none of the {len(queries)} queries, as {first}")
    truth = [_rows(matches[query]) if query in matches else None for query in queries]
    return truth, unmatched


def _finder(frames: Frames) -> Callable[[str], str | None]:
    """A function from an entry to the frame that it names: that with this id, or the only one whose
    id or path ends in the entry, with or without a suffix."""
    paths = frames if isinstance(frames, Mapping) else dict(zip(frames, frames, strict=True))
    by_name: dict[str, list[str]] = {}
    for frame in paths:
        by_name.setdefault(name_of(frame), []).append(frame)

    def find(entry: str) -> str | None:
        if paths.get(entry) == entry:
            return entry
        path = PurePosixPath(entry)
        stems = [path, path.with_suffix("")] if path.suffix.lower() in SUFFIXES else [path]
        fitting = next(filter(None, map(fitting_frames, stems)), [])
        if len(fitting) > 1:
            first, second = (paths[frame] for frame in fitting[:2])
            raise ValueError(
                f"has an entry {entry!r}, which may be {first} or {second}: expected more of the "
                "path"
            )
        return fitting[0] if fitting else None

    def fitting_frames(end: PurePosixPath) -> list[str]:
        return [
            frame
            for frame in by_name.get(end.name, ())
            if any(f"/{name}".endswith(f"/{end}") for name in (frame, paths[frame]))
        ]

    return find


def _from_matrix(matrix: Matrix, queries: int, references: int) -> PartialTruth:
    if matrix.shape != (queries, references):
        raise ValueError(
            f"is a matrix of shape {matrix.shape}, expected {(queries, references)} for "
            f"{queries} queries and {references} references"
        )
    if matrix.dtype.kind not in "biuf" or not np.isin(matrix, (0, 1)).all():
        raise ValueError("is not a matrix of 0 and 1")
    return [np.flatnonzero(row) for row in matrix]


def _from_vpr_bench(rows: Numbers, queries: int, references: int) -> PartialTruth:
    """Rows of numbers from 0, in any order of the queries."""
    if len(rows) != queries:
        raise ValueError(f"has {len(rows)} rows, expected one for each of {queries} queries")
    truth: dict[int, Rows] = {}
    for number, (query, matches) in enumerate(rows):
        if not 0 <= query < queries or query in truth:
            raise ValueError(f"has query {query} in row {number}, expected each of {queries} once")
        outside = [match for match in matches if not 0 <= match < references]
        if outside:
            raise ValueError(
                f"names reference {outside[0]} of query {query}; the database has {references}, "
                "counted from 0"
            )
        truth[query] = _rows(matches)
    return [truth[query] for query in range(queries)]


def _rows(numbers: Iterable[int]) -> Rows:
    return np.array(sorted(set(numbers)), np.int64)
