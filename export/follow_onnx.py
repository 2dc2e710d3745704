#!/usr/bin/env python3
"""Finds drives along a map with an exported or fused file: `run_onnx.py` for whole sequences.

python export/follow_onnx.py place.onnx photos/today --database photos.npy

Each folder is a drive, and its places are those of `ssrvlad query`, by all channels that the file
and the database have and by the same core: own mean off, sweep, fusion, and a hidden Markov model
of the drive along the rows of the map, if the frames run the map at all. --follow online places a
frame by those before it and --delay later ones. A fused file describes label maps from one anchor,
where `ssrvlad query` takes several; `ssrvlad export --sweep` writes a head that does too. Needs
numpy, onnxruntime, the folder `ssrvlad_place` beside it, and the package without torch:
`pip install --no-deps ssrvlad-torch`. Exit code 0 for success, 2 for wrong use, 3 for finished with
some frames skipped.
"""

from __future__ import annotations

import argparse
import sys
from itertools import groupby
from pathlib import Path

from ssrvlad_place.database import Database
from ssrvlad_place.frames import find_frames
from ssrvlad_place.model import Seen, add_model, open_model
from ssrvlad_place.output import finished, note, one_line, report, run_program


def run(options: argparse.Namespace) -> int:
    """Runs the program; the exit code."""
    model = open_model(options)
    database = Database(options.database, model.fingerprints)
    if not database.frames:
        raise ValueError(f"{options.database} holds no frames")
    described: dict[str, Seen] = {}
    skipped = 0
    for frame, path in find_frames(options.source, model.suffixes):
        try:
            if frame in described:
                raise ValueError(f"a second frame {frame}")
            described[frame] = model.see(path)
        except ValueError as error:
            note(f"{path}: {one_line(error)}")
            skipped += 1
    follow = None if options.follow == "no" else options.follow
    for _, group in groupby(described, lambda frame: frame.rpartition("/")[0]):
        drive = list(group)
        seen = [described[frame] for frame in drive]
        answers = database.find(seen, follow, options.delay, options.top)
        for frame, each, answer in zip(drive, seen, answers, strict=True):
            report(frame, not each.descriptor.any(), answer, options.json)
    return finished(skipped, len(described))


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("source", type=Path, nargs="+", help="folders of frames, each a drive")
    parser.add_argument("--database", type=Path, required=True, help=".npy file of a map")
    parser.add_argument("--follow", choices=("offline", "online", "no"), default="offline")
    parser.add_argument("--delay", type=int, default=0, help="later frames of an online answer")
    parser.add_argument("--top", type=int, default=5, help="candidates of each frame")
    parser.add_argument("--json", action="store_true", help="a JSON object a line")
    options = parser.parse_args()
    if options.top < 1 or options.delay < 0 or (options.delay and options.follow != "online"):
        parser.error("expected --top of at least 1, and --delay from 0 with --follow online")
    return run_program("follow_onnx", run, options)


if __name__ == "__main__":
    sys.exit(main())
