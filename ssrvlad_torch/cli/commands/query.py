"""``ssrvlad query``."""

from __future__ import annotations

from typing import Annotated

import typer

from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, SourceOptions
from ..output import finish, note, print_json


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
        bool,
        typer.Option(
            "--index", help="Search by the index on disk, see ssrvlad db index; scores are exact."
        ),
    ] = False,
    as_of: AsOf = None,
    skip_damaged: Annotated[
        bool, typer.Option("--skip-damaged", help="Read on past what is damaged.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Recognise places: ranked candidate frames with scores for every label map.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...database.database import Damage, Database
    from ...database.index import search_index
    from ...database.selection import neighbours, select
    from ...recognition.matching import match
    from ..sources import Source, encode_queries, load_references

    opened = Source.open(source)
    first, last = _window(window)
    if index and (recognition.t or window or skip_damaged):
        raise ValueError("--index does not go with a temporal sum, --window or --skip-damaged")
    town, damage = Database.open(database, as_of), list[Damage]()
    if index:
        references = town.frames()
    else:
        references = load_references(town, recognition.t, damage if skip_damaged else None)
    for entry in damage:
        note(f"left out {entry.rows} frames of {database}/{entry.file}: {entry.reason}")
    where = None
    if from_sequence or window:
        where = select(references, from_sequence, first, last)
    queries, refused = encode_queries(town, opened)
    near = None if exclude is None else neighbours(queries.frames, references, exclude)
    if index:
        spared = None if near is None else [references.frames[a:b] for a, b in near.tolist()]
        found = search_index(town, queries.descriptors, top, threshold, from_sequence, spared)
    else:
        matches = match(queries.descriptors, references.descriptors, top, threshold, where, near)
        found = [
            [(references.frames[row], s) for row, s in zip(rows, scores, strict=True) if row >= 0]
            for scores, rows in zip(*(m.tolist() for m in matches), strict=True)
        ]
    for frame, ranked in zip(queries.frames, found, strict=True):
        candidates = [{"frame": name, "score": score} for name, score in ranked]
        if as_json:
            print_json({"query": frame, "candidates": candidates, "temporal": recognition.t})
        else:
            told = ", ".join(f"{name} {score:.4f}" for name, score in ranked)
            print(f"{frame}: {told or 'no candidate'}")
    finish(refused)


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
