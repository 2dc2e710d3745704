#!/usr/bin/env python3
"""Describes frames with an exported or fused file, and finds them in an exported database.

python export/run_onnx.py head.onnx maps/today --database town.npy --top 3
python export/run_onnx.py place.onnx photos/today --database photos.npy --follow offline
your-camera | python export/run_onnx.py place.onnx - --database photos.npy --follow online
python export/run_onnx.py head.onnx photos --network net.onnx --provider CUDAExecutionProvider

Needs the folder `ssrvlad_place` beside it, and the package without torch, as README.md says. A file
of `ssrvlad export` takes label maps, or with `--input logits` class scores as `.npy` (C, H, W); a
file of `ssrvlad fuse` takes photographs; both as `ssrvlad encode` reads them. With the two files of
`ssrvlad fuse --split` the network runs on --provider and the head on the CPU. Every file is run on
its golden pair when it is loaded, and refused if this runtime gives other outputs.

A database is written by `ssrvlad db export --format npy` or by --save-descriptors. All channels are
used that the file and the database have. Each frame is found by itself, as by `ssrvlad locate`, or
with --follow each folder as a sequence, as by `ssrvlad query`: offline by all its frames, online by
those before it and --delay later ones, or by none (no). Online each answer is printed as soon as it
is known; `-` reads the names of the files of one sequence from standard input. A fused file
describes label maps from one anchor, where `ssrvlad query` takes several; `ssrvlad export --sweep`
writes a head that does too.

Exit code 0 for success, 1 if --check finds the golden pair wrong, 2 for wrong use, 3 for finished
with some frames skipped.
"""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import groupby
from operator import attrgetter
from pathlib import Path

from ssrvlad_place.database import Answer, Database, require_one_line, save
from ssrvlad_place.model import STDIN, Description, add_model, open_model
from ssrvlad_place.output import finished, note, report, run_program

from ssrvlad_torch.datasets.frame_file import FrameFile


def run(options: argparse.Namespace) -> int:
    """Runs the program; the exit code."""
    model = open_model(options)
    if options.check:
        golden = model.golden()
        print(golden)
        return int(bool(golden.problem))
    if options.save_descriptors and model.anchors:
        raise ValueError("--save-descriptors: expected a file without --sweep")
    out = options.save_descriptors
    database = options.database and Database(options.database, model.fingerprints)
    if out and not out.parent.is_dir():
        raise ValueError(f"--save-descriptors: {out.parent} is no folder")
    stored: dict[str, Description] = {}
    waiting = deque[tuple[str, bool]]()
    total = skipped = 0

    def see(group: Iterable[FrameFile]) -> Iterator[Description]:
        nonlocal total, skipped
        for file in group:
            total += 1
            try:
                described = model.see(file)
            except ValueError as error:
                note(f"{file.location}: {error}")
                skipped += 1
                continue
            if out:
                require_one_line(file.frame)
                stored[file.frame] = described
            waiting.append((file.frame, not described.descriptor.any()))
            yield described

    for group in groups_of(model.frames(options.source), options):
        for answer in answers_to(see(group), database, options):
            report(*waiting.popleft(), answer, options.json)
    if stored:
        save(out, list(stored.values()), list(stored), model.fingerprints)
    return finished(skipped, total)


def groups_of(
    files: Iterable[FrameFile], options: argparse.Namespace
) -> Iterable[Iterable[FrameFile]]:
    """Sequences, or frames each alone."""
    if not options.follow:
        return ([file] for file in files)
    if options.source == [STDIN]:
        return [files]
    return (group for _, group in groupby(files, attrgetter("sequence")))


def answers_to(
    frames: Iterator[Description], database: Database | None, options: argparse.Namespace
) -> Iterable[Answer | None]:
    """The answers to the frames of a sequence in their order, each as soon as it is known."""
    if database is None:
        return (None for _ in frames)
    if options.follow == "online":
        return database.track(frames, options.delay, options.top)
    sequence = list(frames)
    follow = "offline" if options.follow == "offline" else None
    return database.find(sequence, follow, options.top) if sequence else []


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("source", type=Path, nargs="*", help="files or folders of frames, or -")
    parser.add_argument("--database", type=Path, help=".npy file of reference descriptors")
    parser.add_argument(
        "--follow", choices=("offline", "online", "no"), help="folders as sequences"
    )
    parser.add_argument("--delay", type=int, default=0, help="later frames of an online answer")
    parser.add_argument("--top", type=int, default=5, help="candidates of each frame")
    parser.add_argument("--save-descriptors", type=Path, metavar="OUT.npy")
    parser.add_argument("--json", action="store_true", help="a JSON object a line")
    parser.add_argument("--check", action="store_true", help="run the golden pair and stop")
    options = parser.parse_args()
    if options.top < 1 or options.delay < 0 or (options.delay and options.follow != "online"):
        parser.error("expected --top of at least 1, and --delay from 0 with --follow online")
    if options.model.exists() and bool(options.source) == options.check:
        parser.error("expected frames or --check")
    return run_program("run_onnx", run, options)


if __name__ == "__main__":
    sys.exit(main())
