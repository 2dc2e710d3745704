"""The tables of scale.py, of the reports of its steps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from _markdown import head_row, row

BESIDE = 2

Report = dict[str, Any]
Results = dict[int, dict[str, Report]]
"""By the number of frames, the report of each step."""


def pictures(results: Results) -> Iterator[str]:
    """A row for each number of frames. A place is the same if it is at most `BESIDE` rows away."""
    yield from head_row(
        "frames", "CPU ms a picture", "by exact search, from disk",
        "first answer of exact search", "where that is a real frame", "its place there",
        "opening, CPU s", "peak GB", "index, CPU s", "index, bytes a frame",
        "database, bytes a frame",
    )  # fmt: skip
    for frames, reports in results.items():
        found, coarse = reports["alone"], reports["coarse"]
        first, expected = (np.array(each["first"]) for each in (found, reports["together"]))
        real = expected >= frames - reports["pictures"]["real"]  # in natural order after all others
        yield row(
            f"{frames:,}", f"{1e3 * found['one']:.0f}",
            f"{1e3 * reports['together']['cpu'] / len(first):.0f}",
            f"{np.mean(first == expected):.3f}",
            f"{np.mean((first == expected)[real]):.3f} of {real.sum()}",
            f"{np.mean(np.abs(first - expected)[real] <= BESIDE):.3f}", f"{found['opening']:.1f}",
            f"{found['peak'] / 1e9:.2f}", f"{coarse['cpu']:.0f}", f"{coarse['bytes'] / frames:.0f}",
            f"{reports['pictures']['bytes'] / frames:.0f}",
        )  # fmt: skip


def drives(results: Results, names: Sequence[str]) -> Iterator[str]:
    """A row for each number of frames and drive, with the index and without."""
    yield from head_row(
        "frames", "drive", "queries", "queries a second", "by exact search",
        "first answer of exact search", "its place", "answers among the real frames",
        "confidence differs by", "peak GB",
    )  # fmt: skip
    for frames, reports in results.items():
        for name in names:
            of, known = reports["drives"][name], reports["drives together"].get(name)
            first = np.array(of["first"])
            real = np.mean(first >= frames - reports["pictures"]["real"])
            same = ["", "", "", ""]
            if known:
                apart = np.abs(first - np.array(known["first"]))
                sure = np.abs(np.array(of["confidence"]) - np.array(known["confidence"])).mean()
                same = [
                    f"{known['rate']:.1f}", f"{np.mean(apart == 0):.3f}",
                    f"{np.mean(apart <= BESIDE):.3f}", f"{sure:.3f}",
                ]  # fmt: skip
            yield row(
                f"{frames:,}", name, f"{len(first)}", f"{of['rate']:.1f}", *same[:3], f"{real:.3f}",
                same[3], f"{reports['drives']['peak'] / 1e9:.2f}",
            )  # fmt: skip


def label_maps(results: Results) -> Iterator[str]:
    """A row for each number of frames."""
    yield from head_row(
        "frames", "written, CPU s", "verified, CPU s", "loaded, CPU s", "query of many, CPU ms",
        "query alone, CPU ms", "peak GB", "bytes a frame",
    )  # fmt: skip
    for frames, reports in results.items():
        written, searched = reports["labels"], reports["labels searched"]
        yield row(
            f"{frames:,}", f"{written['cpu']:.0f}", f"{reports['labels verified']['cpu']:.1f}",
            f"{searched['loading']:.1f}", f"{1e3 * searched['at once']:.1f}",
            f"{1e3 * searched['one']:.0f}", f"{searched['peak'] / 1e9:.2f}",
            f"{written['bytes'] / frames:.0f}",
        )  # fmt: skip
