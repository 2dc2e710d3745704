"""What each category adds to the score of a match, as a table with bars."""

from __future__ import annotations

from html import escape
from typing import NamedTuple

import numpy as np

from ..outcomes import Floats
from .contents import Descriptors
from .matches import Match, parts


class Column(NamedTuple):
    """What each category adds to something.

    Attributes:
        name: of what.
        values: one a category.
        kind: ``part`` for bars from the left, ``lead`` for bars that go both ways from the middle.
        digits: of the values as they are told.
    """

    name: str
    values: Floats
    kind: str = "part"
    digits: int = 3

    def bar(self, place: int) -> str:
        """A cell with a bar that is long as the value is great beside the others."""
        value = self.values[place]
        share = abs(value) / max(float(np.abs(self.values).max()), 1e-9)
        sign = "negative" if value < 0 else "positive"
        style = f'class="{self.kind} {sign}" style="--share:{100 * share:.0f}%"'
        return f"<td {style}>{self.told(value)}</td>"

    def told(self, value: float) -> str:
        """In digits, without a minus before nothing."""
        return f"{round(float(value), self.digits) + 0.0:.{self.digits}f}"


def categories_table(descriptors: Descriptors, match: Match) -> str:
    """What each category adds to the score of what was taken, how much more that is than for the
    true match, and what it adds to the squared difference of query and taken."""
    columns = _columns(descriptors, match)
    head = "".join(f'<th scope="col">{column.name}</th>' for column in columns)
    body = "".join(
        f'<tr><th scope="row">{escape(category)}</th>'
        f"{''.join(column.bar(k) for column in columns)}</tr>"
        for k, category in enumerate(descriptors.categories)
    )
    sums = "".join(f"<td>{column.told(column.values.sum())}</td>" for column in columns)
    return (
        f'<table class="categories"><thead><tr><th scope="col">category</th>{head}</tr></thead>'
        f'<tbody>{body}</tbody><tfoot><tr><th scope="row">sum</th>{sums}</tr></tfoot></table>'
    )


def _columns(descriptors: Descriptors, match: Match) -> list[Column]:
    rows = [match.candidate, *([match.true_match] if match.true_match >= 0 else [])]
    there = descriptors.references[rows]
    added = parts(descriptors.queries[match.query], there, len(descriptors.categories))
    columns = [Column("adds to the score", added.score[0])]
    if match.true_match >= 0:
        lead = added.score[0] - added.score[1]
        columns.append(Column("more than for the true match", lead, "lead", digits=4))
    return [*columns, Column("squared difference", added.difference[0])]
