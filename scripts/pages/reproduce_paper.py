#!/usr/bin/env python3
"""Writes docs/paper.md: the paper's tables and its figure, ours beside its own.

    .venv/bin/python scripts/pages/reproduce_paper.py --camvid ../shared/data/camvid

The paper's data sets are taken from `--data`, each if it is there: `Synthia-NightToFall` and
`CrossSeason_CoHOG_Dataset` as VPR-Bench lays them out, `slice7` of Extended CMU Seasons. Name these
folders, or those that hold them; `--dry-run` lists what is looked for and what is found. Their
label maps lie in `labels/<sequence>/<name of the image>.png` of each, or a `--segmenter` makes
them. CamVid (see `_problems.py`) and the synthetic city are measured beside them. Results are kept
in `--cache`, and an interrupted run goes on where it was. Needs the extra `eval`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import _paper_cost
import _paper_noise
import _paper_quality
from _markdown import write
from _trials import Cache

from ssrvlad_torch.cli.bench import threads

PARTS = {"table1": _paper_quality.part, "table3": _paper_cost.part, "table4": _paper_noise.part}

HEAD = """# The paper's experiments

Written by `scripts/pages/reproduce_paper.py`; no own number is typed by hand. The paper's are those
of Nie, Feng et al., arXiv 2202.03677.
"""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    told = "folder of one of the paper's data sets, or of several; repeatable"
    arguments.add_argument("--data", type=Path, action="append", default=[], help=told)
    arguments.add_argument("--dry-run", action="store_true", help="list what is found, and end")
    arguments.add_argument("--camvid", type=Path, help="folder of CamVid")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    arguments.add_argument("--segmenter", type=Path, help="an .onnx file, or a .yaml that names it")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/trials"))
    arguments.add_argument("--only", choices=PARTS, help="print this part and write no page")
    arguments.add_argument("--output", type=Path, default=Path("docs/paper.md"))
    options = arguments.parse_args()
    if options.dry_run:
        print("\n".join(_paper_quality.looked_for(options)))
        return
    kept = Cache(options.cache)
    with threads(1):
        parts = [PARTS[name](options, kept) for name in PARTS if options.only in (None, name)]
    page = "\n".join([HEAD, *(line for part in parts for line in part)]) + "\n"
    print(page)
    if options.only is None:
        write(options.output, page)


if __name__ == "__main__":
    main()
