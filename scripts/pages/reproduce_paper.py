#!/usr/bin/env python3
"""Writes docs/paper.md: the tables and the figure of the paper, with our results beside them.

    .venv/bin/python scripts/pages/reproduce_paper.py --camvid ../shared/data/camvid

`--data` names the folders of the paper's data sets, or folders that contain them:
`Synthia-NightToFall` and `CrossSeason_CoHOG_Dataset` in the layout of VPR-Bench, and `slice7` of
Extended CMU Seasons. Missing ones are listed and left out. Label maps are read from
`labels/<sequence>/<name of the image>.png` in each folder, or made by `--segmenter`. CamVid (see
`_trials.py`) and the synthetic city are also measured. Descriptors are cached in `--cache`, so an
interrupted run can be resumed. Needs the extra `eval`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import _paper_cost
import _paper_quality
from _described import Described
from _markdown import Page
from _timing import threads

PARTS = {"table1": _paper_quality.part, "table3": _paper_cost.part}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    data = "folder of one of the paper's data sets, or of several; repeatable"
    arguments.add_argument("--data", type=Path, action="append", default=[], help=data)
    arguments.add_argument("--camvid", type=Path, help="folder of CamVid")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    arguments.add_argument("--segmenter", type=Path, help="an .onnx file, or a .yaml that names it")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/described"))
    arguments.add_argument("--only", choices=PARTS, help="measure this part only")
    arguments.add_argument("--output", type=Path, default=Path("docs/paper.md"))
    options = arguments.parse_args()
    described = Described(None, options.cache, {}, options.weights, options.segmenter)
    page = Page("paper.md", options.output)
    with threads(1):
        for name, part in PARTS.items():
            if options.only in (None, name):
                part(page, options, described)


if __name__ == "__main__":
    main()
