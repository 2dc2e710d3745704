"""``ssrvlad query``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..options import DatabaseFolder, Json, RecognitionOptions, SourceOptions
from ..output import finish, note, print_json

if TYPE_CHECKING:
    from ...database.database import FrameSet
    from ...recognition.matching import Matches

Index = Literal["exact", "mapped", "faiss-ivfpq"]
Precision = Literal["float32", "float16"]


def query(
    database: DatabaseFolder,
    source: SourceOptions,
    recognition: RecognitionOptions,
    top: Annotated[int, typer.Option(min=1, help="Candidates of each query.")] = 5,
    threshold: Annotated[
        float | None, typer.Option(help="Leave out candidates whose score is not above it.")
    ] = None,
    from_sequence: Annotated[
        list[str] | None,
        typer.Option(help="Candidates of this sequence only; repeatable."),
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(
            help="FIRST:LAST, either may be left out: candidates whose number, or time stamp, is "
            "between them. It is the last number in a frame's name."
        ),
    ] = None,
    exclude: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="No candidates from a query's own sequence that are at most so many frames away.",
        ),
    ] = None,
    index: Annotated[
        Index,
        typer.Option(
            help="exact: descriptors in memory; mapped: exact, read from the disk as they are "
            "needed; faiss-ivfpq: an index of faiss, for more than memory."
        ),
    ] = "exact",
    precision: Annotated[
        Precision, typer.Option(help="float16 halves what exact and mapped hold.")
    ] = "float32",
    skip_damaged: Annotated[
        bool, typer.Option("--skip-damaged", help="Read on past what is damaged.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Recognise places: ranked candidate frames with scores for every label map.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...database.database import Database
    from ...database.selection import neighbours, select
    from ..sources import Source, encode_queries

    opened = Source.open(source)
    first, last = _window(window)
    references, searcher = _open(database, recognition.t, index, precision, skip_damaged)
    where = None
    if from_sequence or window:
        where = select(references, from_sequence, first, last)
    queries, refused = encode_queries(Database.open(database, skip_damaged).config, opened)
    near = None if exclude is None else neighbours(queries.frames, references, exclude)
    found = searcher(queries.descriptors, top, threshold, where, near)
    for frame, scores, rows in zip(queries.frames, *found, strict=True):
        candidates = [
            {"frame": references.frames[row], "score": score}
            for row, score in zip(rows.tolist(), scores.tolist(), strict=True)
            if row >= 0
        ]
        if as_json:
            print_json({"query": frame, "candidates": candidates, "temporal": recognition.t})
        else:
            ranked = ", ".join(f"{c['frame']} {c['score']:.4f}" for c in candidates)
            print(f"{frame}: {ranked or 'no candidate'}")
    finish(refused)


def _open(
    path: Path, temporal: int, index: Index, precision: Precision, skip_damaged: bool
) -> tuple[FrameSet, Callable[..., Matches]]:
    """The references, and what finds the best of them, called as `match` but without them."""
    from ...database.database import Database
    from ...database.searching import Ivfpq, load_mapped
    from ...recognition.matching import match

    database = Database.open(path, skip_damaged)
    if not len(database):
        raise ValueError(f"{path} holds no frames yet")
    if index == "exact":
        references = database.load(temporal)
        if precision == "float16":
            references = replace(references, descriptors=references.descriptors.half())
    else:
        references = load_mapped(database, temporal, precision)
    for entry in database.damage:
        note(f"left out {path / entry.file}{entry.place}: {entry.reason}")
    descriptors = references.descriptors
    if index != "faiss-ivfpq":
        return references, lambda queries, *limits: match(queries, descriptors, *limits)
    searcher = Ivfpq.of(database, descriptors, temporal)
    if searcher.report:
        at = searcher.report.recall_at
        note(
            f"built an index of {searcher.report.lists} lists, {searcher.report.bytes} bytes; of "
            f"the exact best it finds {at[1]:.3f} at 1 and {at[10]:.3f} at 10"
        )
    return references, searcher.match


def _window(text: str | None) -> tuple[int | None, int | None]:
    if text is None:
        return None, None
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return int(first) if first else None, int(last) if last else None
    except ValueError:
        raise ValueError(f"--window wants FIRST:LAST in whole numbers, got {text!r}") from None
