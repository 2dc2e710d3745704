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
    from ...database.selection import neighbours, select
    from ...recognition.matching import match
    from ..sources import Source, encode_queries, load_references

    opened = Source.open(source)
    first, last = _window(window)
    town, damage = Database.open(database, as_of), list[Damage]()
    references = load_references(town, recognition.t, damage if skip_damaged else None)
    for entry in damage:
        note(f"left out {entry.rows} frames of {database / entry.file}: {entry.reason}")
    where = None
    if from_sequence or window:
        where = select(references, from_sequence, first, last)
    queries, refused = encode_queries(town, opened)
    near = None if exclude is None else neighbours(queries.frames, references, exclude)
    found = match(queries.descriptors, references.descriptors, top, threshold, where, near)
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
