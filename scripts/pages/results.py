#!/usr/bin/env python3
"""Writes docs/results.md: both presets beside trivial baselines, under every condition.

    .venv/bin/python scripts/pages/results.py --camvid ../shared/data/camvid

The conditions and the folder are those of `conditions.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from conditions import (
    CAMVID_CONDITIONS,
    CITY_FRAMES,
    CITY_SEEDS,
    RESAMPLES,
    Describe,
    Drive,
    described_by,
    figures,
    search_all,
)
from torch import Tensor

from ssrvlad_torch import SSRVLADConfig, baselines
from ssrvlad_torch.baselines.protocol import Frame
from ssrvlad_torch.datasets.image_files import decode_image

REACHES = (0, 1, 3)
FIGURES = ("RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision")

HEAD = f"""# Results

Written by `scripts/pages/results.py`; no number is typed by hand. In brackets stand 95 % bootstrap
intervals over the queries ({RESAMPLES} resamples), of metrics by the convention `exact`. t is the
reach of the temporal sum (Eq. 3) over the references. `label grid` is the trivial baseline: the
fractions of the eight categories in a 6 x 10 grid (480 numbers), square root, normalised; `HOG`
is that of the pictures, which only CamVid has (480 numbers).

CamVid: the even frames of {{sequences}} in one database, the odd frames are the queries, and a
true match is a neighbouring frame. `espnetv2` and `dicenet` are the outputs of real networks,
which were trained on other data. City: {len(CITY_SEEDS)} cities of {CITY_FRAMES} reference frames
and {CITY_FRAMES} queries a drive, each searched in its own city; a true match is within 5 m. The
query always drives 0.7 m to the left of the reference, among other cars; `noise` is the strength
of simulated segmentation mistakes, of which 1 is a mild network and 5 a bad one.
"""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, default=None)
    arguments.add_argument("--output", type=Path, default=Path("docs/results.md"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    measured: Measured = {}
    for method, describe in methods(options.camvid).items():
        once = remembered(describe)
        for reach in REACHES:
            found = search_all(once, options.camvid, reach)
            measured[method, reach] = {name: figures(searches) for name, searches in found}
            print(f"{method}, t = {reach}", flush=True)
    sequences = sorted(p.name for p in options.camvid.iterdir()) if options.camvid else ["no drive"]
    text = [HEAD.format(sequences=" and ".join(sequences)), *summary(measured)]
    for figure in FIGURES:
        text += table(figure, measured)
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text("\n".join(text) + "\n", encoding="utf-8")
    print(options.output)
    quote_in_readme(options.output)


EXCERPT = ("labels -> labels", "espnetv2 -> labels", "clean", "2 m aside", "all together")


def quote_in_readme(results: Path, readme: Path = Path("README.md")) -> None:
    """Puts some lines of RecallRate@1 at t = 0 between the marks that README.md has for them."""
    before, _, after = readme.read_text(encoding="utf-8").partition("<!-- results -->\n")
    _, mark, after = after.partition("<!-- /results -->")
    text = excerpt(results.read_text(encoding="utf-8"))
    readme.write_text(f"{before}<!-- results -->\n{text}\n{mark}{after}", encoding="utf-8")


def excerpt(page: str) -> str:
    """The methods of a results page by some conditions, RecallRate@1 at t = 0."""
    lines = page.partition("## RecallRate@1\n")[2].partition("\n##")[0].splitlines()
    head, _, *rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("|")]
    chosen = [0, *(i for i, name in enumerate(head) if name.endswith(", t = 0"))]
    table = [head, *(row for row in rows if row[0] in EXCERPT)]
    columns = [[row[i].removesuffix(", t = 0") for row in table] for i in chosen]
    columns.insert(1, ["---"] * len(table))
    return "\n".join(f"| {' | '.join(column)} |" for column in columns)


def methods(folder: Path | None) -> dict[str, Describe]:
    presets = ("paper", "default")
    return {
        **{f"SSR-VLAD, {p}": described_by(SSRVLADConfig.from_preset(p)) for p in presets},
        "label grid": described_by_baseline("label-grid"),
        **({"HOG": described_by_baseline("hog")} if folder else {}),
    }


def remembered(describe: Describe) -> Describe:
    """Describes a drive once; `conditions` makes each drive once."""
    known: dict[int, Tensor] = {}

    def look_up(drive: Drive) -> Tensor:
        if id(drive) not in known:
            known[id(drive)] = describe(drive)
        return known[id(drive)]

    return look_up


def described_by_baseline(name: str) -> Describe:
    method = baselines.make(name)

    def describe(drive: Drive) -> Tensor:
        if "images" in method.needs and not drive.pictures:
            return torch.zeros(len(drive.frames), 480)
        return method.encode_query(frames(drive))

    return describe


def frames(drive: Drive) -> Iterator[Frame]:
    pictures: Iterable[Path | None] = drive.pictures or [None] * len(drive.frames)
    for frame, labels, picture in zip(drive.frames, drive.maps, pictures, strict=True):
        yield Frame(
            frame, labels, drive.labels_as, decode_image(picture.read_bytes()) if picture else None
        )


Measured = dict[tuple[str, int], dict[str, dict[str, list[float]]]]


def summary(measured: Measured) -> Iterator[str]:
    """Means over the conditions, and in how many of them a method is worse than the grid."""
    yield "## In short\n"
    yield "Means over the conditions at t = 0, without intervals; the tables below have them.\n"
    yield f"| method | {' | '.join(f'{f}: CamVid | {f}: city' for f in FIGURES)} |"
    yield f"| {' | '.join(['---'] * (1 + 2 * len(FIGURES)))} |"
    for (method, reach), found in measured.items():
        if reach == 0:
            cells = [mean(found, figure, kind) for figure in FIGURES for kind in (True, False)]
            yield f"| {method} | {' | '.join(cells)} |"
    yield ""
    ours, grid = measured["SSR-VLAD, default", 0], measured["label grid", 0]
    for figure in FIGURES:
        worse = [name for name in grid if ours[name][figure][0] < grid[name][figure][0]]
        yield (
            f"- {figure}: `default` is below the grid in {len(worse)} of {len(grid)} conditions"
            + (f" ({', '.join(worse)})." if worse else ".")
        )
    yield ""


def mean(found: dict[str, dict[str, list[float]]], figure: str, on_camvid: bool) -> str:
    values = [
        value[figure][0]
        for name, value in found.items()
        if (name in CAMVID_CONDITIONS) == on_camvid
    ]
    return f"{sum(values) / len(values):.3f}" if values and any(values) else "-"


def table(figure: str, measured: Measured) -> Iterator[str]:
    columns = list(measured)
    yield f"## {figure}\n"
    yield f"| condition | {' | '.join(f'{method}, t = {reach}' for method, reach in columns)} |"
    yield f"| {' | '.join(['---'] * (1 + len(columns)))} |"
    for name in measured[columns[0]]:
        cells = [cell(measured[column][name][figure], column[0], name) for column in columns]
        yield f"| {name} | {' | '.join(cells)} |"
    yield ""


def cell(figure: list[float], method: str, condition: str) -> str:
    if method == "HOG" and condition not in CAMVID_CONDITIONS:
        return "-"
    return "{:.3f} [{:.3f}, {:.3f}]".format(*figure)


if __name__ == "__main__":
    main()
