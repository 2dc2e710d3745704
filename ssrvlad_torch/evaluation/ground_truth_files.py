"""Ground truth from files: pairs of frames, a 0/1 matrix, or VPR-Bench's pickled rows."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import one_line
from ..untrusted import check_regular, npy_header, parse_npy, read_bytes, read_json, read_npz
from .object_arrays import PickledArray, load_object_array
from .outcomes import Rows

Matrix = npt.NDArray[Any]
Pairs = dict[str, list[str]]
"""True matches of each query that an entry names, by ids."""
Known = list[Rows | None]
"""True matches of each query; ``None`` where the ground truth says nothing of a query."""


Frames = Sequence[str] | Mapping[str, str]
"""Frame ids ``<sequence>/<name>`` in order; in a mapping each with the whole path of its file."""


def from_file(path: str | Path, queries: Frames, references: Frames) -> Known:
    """True matches from a file of any known form, chosen by its suffix and what is in it.

    | file | holds |
    |---|---|
    | ``.json`` | ``{"<query>": ["<reference>", ...]}`` or ``[["<query>", "<reference>"], ...]`` |
    | ``.csv`` | a first line ``query,reference`` and a line for each pair, or a 0/1 matrix |
    | ``.npy``, ``.npz`` | a 0/1 matrix ``(Q, R)``; ``GThard`` ``(R, Q)`` as in VPR-Tutorial |
    | ``.npy`` of objects | VPR-Bench's ``ground_truth_new.npy``: ``[query, [reference, ...]]`` |

    Pairs name references by their ids, or by any end of a path that only one frame has, and queries
    by the latter: their ids depend on what else is asked. Of a query that no entry names nothing is
    known: to say that it has no true match, give it an empty list, or in CSV a line with an empty
    reference. A matrix and VPR-Bench's rows count frames from 0 in the order of ``queries`` and
    ``references``.

    Args:
        path: the file.
        queries, references: the frames.

    Raises:
        ValueError: the file cannot be read, has another form, size or number of queries, names a
            reference that is not there, has an entry for none of the queries, or one that may mean
            several frames.
    """
    found = _content(Path(path))
    try:
        if isinstance(found, dict):
            return _of_pairs(found, queries, references)
        if isinstance(found, PickledArray):
            return _of_vpr_bench(found, len(queries), len(references))
        return _of_matrix(found, len(queries), len(references))
    except ValueError as error:
        raise ValueError(f"ground truth {path} {error}") from error


def strange_entries(path: str | Path, queries: Frames) -> list[str]:
    """Entries of a file of pairs that name none of the queries; none of a file that counts frames.

    Raises:
        ValueError: the file cannot be read, or has another form.
    """
    found, find = _content(Path(path)), _finder(queries)
    return [entry for entry in found if find(entry) is None] if isinstance(found, dict) else []


def _content(path: Path) -> Pairs | PickledArray | Matrix:
    if path.suffix.lower() not in READERS:
        raise ValueError(
            f"cannot read the ground truth {path}: expected a file in {', '.join(READERS)}"
        )
    try:
        check_regular(path)
        return READERS[path.suffix.lower()](path)
    except Exception as error:  # what decoders raise on damaged bytes has no bounds
        raise ValueError(f"cannot read the ground truth {path}: {one_line(error)}") from error


def of_known(truth: Known) -> tuple[list[int], list[Rows]]:
    """The numbers of the queries that the ground truth knows, and their true matches."""
    known = {query: matches for query, matches in enumerate(truth) if matches is not None}
    return list(known), list(known.values())


def _read_json(path: Path) -> Pairs:
    content = read_json(path)
    if isinstance(content, dict) and all(map(_is_ids, content.values())):
        return content
    if isinstance(content, list) and all(_is_ids(pair) and len(pair) == 2 for pair in content):
        return _grouped(content)
    raise ValueError(
        'expected {"<query id>": ["<reference id>", ...], ...} or '
        '[["<query id>", "<reference id>"], ...]'
    )


def _read_csv(path: Path) -> Pairs | Matrix:
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = csv.DictReader(file, restval="", skipinitialspace=True)
        first = lines.fieldnames or ()
        if {"query", "reference"} <= set(first):
            return _grouped((line["query"], line["reference"]) for line in lines)
    if not first or not all(map(_is_number, first)):
        raise ValueError("expected a first line query,reference or a matrix of 0 and 1")
    return np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")


def _read_npy(path: Path) -> PickledArray | Matrix:
    with path.open("rb") as file:
        if npy_header(file)[2].hasobject:
            return load_object_array(file)
    return parse_npy(read_bytes(path))


def _read_npz(path: Path) -> Matrix:
    arrays = read_npz(path)
    if "GThard" in arrays:
        return arrays["GThard"].T
    if len(arrays) != 1:
        raise ValueError(f"expected one matrix, or GThard, got {', '.join(arrays)}")
    return next(iter(arrays.values()))


READERS: dict[str, Callable[[Path], Pairs | PickledArray | Matrix]] = {
    ".json": _read_json,
    ".csv": _read_csv,
    ".npy": _read_npy,
    ".npz": _read_npz,
}
"""What reads a file, by its suffix."""


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_ids(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(frame, str) for frame in value)


def _grouped(pairs: Iterable[Sequence[str]]) -> Pairs:
    """References by query; an empty reference marks a known query without a true match."""
    grouped: Pairs = {}
    for query, reference in pairs:
        grouped.setdefault(query, []).extend([reference] if reference else [])
    return grouped


def _of_pairs(pairs: Pairs, queries: Frames, references: Frames) -> Known:
    asked, known = _finder(queries), _finder(references)
    row = {frame: number for number, frame in enumerate(references)}
    matches: dict[str, list[int]] = {}
    for entry, named in pairs.items():
        if (query := asked(entry)) is None:
            continue
        rows = matches.setdefault(query, [])
        for frame in named:
            if (reference := frame if frame in row else known(frame)) is None:
                raise ValueError(f"names reference {frame!r}, which is not in the database")
            rows.append(row[reference])
    if queries and not matches:
        first = next(iter(queries))
        raise ValueError(f"has an entry for none of the {len(queries)} queries, as {first}")
    return [_rows(matches[query]) if query in matches else None for query in queries]


def _finder(frames: Frames) -> Callable[[str], str | None]:
    """Looks up which frame an entry means: the only one whose id or path ends so, or one of this id
    that has no path."""
    paths = frames if isinstance(frames, Mapping) else dict(zip(frames, frames, strict=True))
    called: dict[str, list[str]] = {}
    for frame in paths:
        called.setdefault(frame.rpartition("/")[2], []).append(frame)

    def find(entry: str) -> str | None:
        if paths.get(entry) == entry:
            return entry
        ends = [
            frame
            for frame in called.get(entry.rpartition("/")[2], ())
            if any(f"/{name}".endswith(f"/{entry}") for name in (frame, paths[frame]))
        ]
        if len(ends) > 1:
            raise ValueError(
                f"has an entry {entry!r}, which may be {paths[ends[0]]} or {paths[ends[1]]}: "
                "expected more of the path"
            )
        return ends[0] if ends else None

    return find


def _of_matrix(matrix: Matrix, queries: int, references: int) -> Known:
    if matrix.shape != (queries, references):
        raise ValueError(
            f"is a matrix of shape {matrix.shape}, expected {(queries, references)} for "
            f"{queries} queries and {references} references"
        )
    if matrix.dtype.kind not in "biuf" or not np.isin(matrix, (0, 1)).all():
        raise ValueError("is no matrix of 0 and 1")
    return [np.flatnonzero(row) for row in matrix]


def _of_vpr_bench(rows: PickledArray, queries: int, references: int) -> Known:
    """Rows ``[query, [reference, ...]]`` of numbers from 0, in any order of the queries."""
    if len(rows) != queries:
        raise ValueError(f"has {len(rows)} rows, expected one for each of {queries} queries")
    truth: dict[int, Rows] = {}
    for place, row in enumerate(rows):
        query, matches = _row(place, row)
        if not 0 <= query < queries or query in truth:
            raise ValueError(f"has query {query} in row {place}, expected each of {queries} once")
        past = [match for match in matches if not 0 <= match < references]
        if past:
            raise ValueError(
                f"names reference {past[0]} of query {query}; the database has {references}, "
                "counted from 0"
            )
        truth[query] = _rows(matches)
    return [truth[query] for query in range(queries)]


def _row(place: int, row: Any) -> tuple[int, list[int]]:
    try:
        query, matches = row
        numbers = [query, *matches]
        whole = [int(number) for number in numbers]
        if whole == numbers:
            return whole[0], whole[1:]
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"has no [query, [reference, ...]] of whole numbers in row {place}")


def _rows(numbers: Iterable[int]) -> Rows:
    return np.array(sorted(set(numbers)), np.int64)
