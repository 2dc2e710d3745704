"""Candidates as an HTML table, for notebooks."""

import math

from torch import Tensor

_MAX_QUERIES, _MAX_CANDIDATES = 10, 5


def candidates_table(scores: Tensor, rows: Tensor, **columns: Tensor) -> str:
    """The row and the score ``(Q, top)`` of the best candidates of the first queries, and further
    numbers ``(Q,)`` of each query by their names."""

    def cell(row: int, score: float) -> str:
        return "none" if math.isinf(score) else f"row {row} ({score:.3f})"

    queries, top = rows.shape
    shown = min(top, _MAX_CANDIDATES)
    names = ["query", *(f"candidate {n}" for n in range(1, shown + 1)), *columns]
    lines = [
        [
            str(query),
            *map(cell, rows[query, :shown].tolist(), scores[query, :shown].tolist()),
            *(f"{column[query]:.3f}" for column in columns.values()),
        ]
        for query in range(min(queries, _MAX_QUERIES))
    ]
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in line)}</tr>" for line in lines)
    left = queries - len(lines)
    more = f"<p>{left} more queries</p>" if left else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"
