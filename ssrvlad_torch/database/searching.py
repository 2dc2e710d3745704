"""Ways to search a database: exact in memory or memory-mapped, or by an index of faiss.

What they derive from a database lies in its folder, named by what it was derived from, so that it
is never taken for that of other rows. It can be deleted at any time.
"""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..files import replacing
from ..recognition.matching import Matches, match
from .database import DERIVED, Database, FrameSet, mapped_array

if TYPE_CHECKING:
    import faiss

Precision = Literal["float32", "float16"]

_BLOCK = 1 << 14
_NUMBERS_OF_A_CODE = 8
_TRAINING_ROWS_OF_A_LIST = 39
_LEAST_ROWS = 256 * _TRAINING_ROWS_OF_A_LIST
_CANDIDATES_OF_A_MATCH = 20
_SAMPLE = 500


class IndexReport(NamedTuple):
    """What an index is worth.

    Attributes:
        lists: number of inverted lists.
        probes: lists that are looked through for a query.
        bytes: size of the index.
        recall_at: for N of 1 and 10, the share of the exact N best matches of `_SAMPLE` frames,
            the frame itself aside, that the index finds among its N best.
    """

    lists: int
    probes: int
    bytes: int
    recall_at: dict[int, float]


def load_mapped(
    database: Database, temporal: int = 0, precision: Precision = "float32"
) -> FrameSet:
    """All frames of a database, their descriptors memory-mapped: read as they are needed.

    The matrix is written at the first time, and whenever the database has changed.

    Args:
        database: the references.
        temporal: t of Eq. 3.
        precision: half halves the file; scores then differ by up to about 1e-3.

    Raises:
        ValueError: a part is missing or damaged.
        OSError: the matrix cannot be written.
    """
    file = _matrix_file(database, temporal, precision)
    if not file.exists():
        _write_matrix(database, temporal, precision, file)
    frames = database.frames()
    descriptors = torch.from_numpy(np.load(file, mmap_mode="c"))
    return dataclasses.replace(frames, descriptors=descriptors, empty=_empty(descriptors))


class Ivfpq:
    """An index of faiss: inverted lists of product-quantised descriptors, for more than memory.

    What it finds is scored anew with the stored descriptors, so scores are exact, and only a
    candidate that it passes over is lost. Use `of`.

    Attributes:
        references: what is searched, best memory-mapped.
        report: how it was built; ``None`` if it was there.
    """

    def __init__(
        self, index: faiss.IndexIVFPQ, references: Tensor, report: IndexReport | None
    ) -> None:
        self.references = references
        self.report = report
        self._index = index

    @classmethod
    def of(cls, database: Database, references: Tensor, temporal: int) -> Ivfpq:
        """The index of a database, built the first time and whenever the database has changed.

        Args:
            database: holds the references.
            references: ``(R, D)`` float after Eq. 3.
            temporal: t of Eq. 3, to tell indices apart.

        Raises:
            ValueError: there are too few references to train an index.
            ImportError: the extra ``search`` is not installed.
            OSError: the index cannot be written.
        """
        faiss = _faiss()
        file = _derived(database, f"t{temporal}.ivfpq")
        if file.exists():
            return cls(faiss.read_index(str(file)), references, None)
        index = _build(faiss, references)
        with replacing(file) as temporary:
            try:
                faiss.write_index(index, str(temporary))
            except RuntimeError as error:
                raise OSError(f"{file} cannot be written: {error}") from error
        built = cls(index, references, None)
        recall = built._recall()
        built.report = IndexReport(index.nlist, index.nprobe, file.stat().st_size, recall)
        return built

    def match(
        self,
        queries: Tensor,
        top: int = 5,
        threshold: float | None = None,
        where: npt.NDArray[np.bool_] | None = None,
        exclude: npt.NDArray[np.int64] | None = None,
    ) -> Matches:
        """As `matching.match`, but for candidates that the index passes over."""
        faiss = _faiss()
        wanted = torch.nn.functional.normalize(queries.float(), dim=1)
        spared = 0 if exclude is None or not len(exclude) else int(np.ptp(exclude, axis=1).max())
        count = min(len(self.references), max(100, _CANDIDATES_OF_A_MATCH * top) + spared)
        settings = faiss.SearchParametersIVF(nprobe=self._index.nprobe)
        if where is not None:
            settings.sel = selector = faiss.IDSelectorBatch(np.flatnonzero(where))
        _, found = self._index.search(wanted.numpy(), count, params=settings)
        if where is not None:
            del selector
        matches = [
            self._rescored(query[None], rows, top, threshold, limits)
            for query, rows, limits in zip(
                wanted, found, exclude if exclude is not None else [None] * len(wanted), strict=True
            )
        ]
        scores, indices = (
            (torch.cat(each) for each in zip(*matches, strict=True))
            if matches
            else (torch.empty(0, top), torch.empty(0, top, dtype=torch.int64))
        )
        return Matches(scores, indices)

    def _rescored(
        self,
        query: Tensor,
        rows: npt.NDArray[np.int64],
        top: int,
        threshold: float | None,
        limits: npt.NDArray[np.int64] | None,
    ) -> Matches:
        rows = np.sort(rows[rows >= 0])
        if limits is not None:
            rows = rows[(rows < limits[0]) | (rows >= limits[1])]
        kept = torch.from_numpy(rows)
        scores, places = match(query, self.references[kept], top, threshold)
        indices = torch.full_like(places, -1)
        indices[places >= 0] = kept[places[places >= 0]]
        return Matches(scores, indices)

    def _recall(self) -> dict[int, float]:
        generator = np.random.default_rng(0)
        count = min(_SAMPLE, len(self.references))
        rows = np.sort(generator.choice(len(self.references), count, replace=False))
        queries = self.references[torch.from_numpy(rows)].float()
        itself = np.stack([rows, rows + 1], axis=1)
        exact = match(queries, self.references, 10, exclude=itself).indices
        found = self.match(queries, 10, exclude=itself).indices
        return {n: _share(exact[:, :n], found[:, :n]) for n in (1, 10)}


def _share(wanted: Tensor, found: Tensor) -> float:
    hits = (wanted[:, :, None] == found[:, None, :]).any(2) & (wanted >= 0)
    return float(hits.sum() / (wanted >= 0).sum().clamp(min=1))


def _build(faiss: Any, references: Tensor) -> Any:
    rows, length = references.shape
    if rows < _LEAST_ROWS:
        raise ValueError(
            f"an index of faiss wants at least {_LEAST_ROWS} references to learn from, got {rows}; "
            "search them exactly"
        )
    lists = min(int(4 * rows**0.5), rows // _TRAINING_ROWS_OF_A_LIST)
    codes = max(m for m in range(1, length // _NUMBERS_OF_A_CODE + 1) if length % m == 0)
    quantiser = faiss.IndexFlatIP(length)
    index = faiss.IndexIVFPQ(quantiser, length, lists, codes, 8, faiss.METRIC_INNER_PRODUCT)
    index.own_fields = True
    quantiser.this.disown()
    index.nprobe = max(1, lists // 16)
    wanted = min(rows, max(_LEAST_ROWS, _TRAINING_ROWS_OF_A_LIST * lists))
    sample = np.sort(np.random.default_rng(0).choice(rows, wanted, replace=False))
    index.train(_units(references[torch.from_numpy(sample)]))
    for first in range(0, rows, _BLOCK):
        index.add(_units(references[first : first + _BLOCK]))
    return index


def _units(vectors: Tensor) -> npt.NDArray[np.float32]:
    unit: npt.NDArray[np.float32] = torch.nn.functional.normalize(vectors.float(), dim=1).numpy()
    return unit


def _write_matrix(database: Database, temporal: int, precision: Precision, file: Path) -> None:
    with replacing(file) as temporary, ExitStack() as after:
        if precision == "float32":
            database.load_into(partial(mapped_array, temporary), temporal)
            return
        single = _matrix_file(database, temporal, "float32")
        if not single.exists():
            after.callback(single.unlink, missing_ok=True)
        whole = load_mapped(database, temporal).descriptors
        half = mapped_array(temporary, (len(whole), whole.shape[1]), np.float16)
        for first in range(0, len(whole), _BLOCK):
            half[first : first + _BLOCK] = whole[first : first + _BLOCK].numpy()


def _matrix_file(database: Database, temporal: int, precision: Precision) -> Path:
    return _derived(database, f"t{temporal}-{precision}.npy")


def _empty(descriptors: Tensor) -> npt.NDArray[np.bool_]:
    blocks = (descriptors[first : first + _BLOCK] for first in range(0, len(descriptors), _BLOCK))
    return np.concatenate([np.zeros(0, bool), *(~block.any(dim=1).numpy() for block in blocks)])


def _derived(database: Database, name: str) -> Path:
    return database.path / f"{DERIVED}{database.content[:16]}-{name}"


def _faiss() -> Any:
    try:
        import faiss
    except ImportError as error:
        raise ImportError("an index of faiss needs: pip install ssrvlad-torch[search]") from error
    return faiss
