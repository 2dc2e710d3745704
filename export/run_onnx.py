#!/usr/bin/env python3
"""Describes frames with an exported or fused file, and finds them in an exported database.

python export/run_onnx.py head.onnx maps/today --database town.npy --top 3
python export/run_onnx.py head.onnx photos --network net.onnx --provider CUDAExecutionProvider

Needs numpy, onnxruntime and the folder `ssrvlad_place` beside it, Pillow for pictures, but not for
`.npy` arrays, and for --database the package without torch: `pip install --no-deps ssrvlad-torch`.
A file of `ssrvlad export` takes label maps: gray or palette images as PNG,
TIFF or BMP, or `.npy` (H, W); with `--input logits` class scores as `.npy` (C, H, W). A file of
`ssrvlad fuse` takes photographs: JPEG, PNG, WebP, BMP, TIFF, PPM or `.npy` (H, W, 3). With the two
files of `ssrvlad fuse --split` the network runs on --provider and the head on the CPU. Every file
is run on its golden pair when it is loaded, and refused if this runtime gives other outputs. A
database is written by `ssrvlad db export --format npy` or by --save-descriptors. Where the file and
the database have features and HOG, they are fused with the descriptors of label maps. Each frame is
judged alone, without the steps of `ssrvlad query`; `follow_onnx.py` takes them for drives. Exit
code 0 for success, 1 if --check finds the golden pair wrong, 2 for wrong use, 3 for finished with
some frames skipped.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ssrvlad_place.database import Database, require_one_line, save
from ssrvlad_place.frames import find_frames
from ssrvlad_place.model import Seen, add_model, open_model
from ssrvlad_place.output import finished, note, report, run_program


def run(options: argparse.Namespace) -> int:
    """Runs the program; the exit code."""
    model = open_model(options)
    if options.check:
        golden = model.golden()
        print(golden)
        return int(not golden.holds)
    if options.save_descriptors and model.anchors:
        raise ValueError("--save-descriptors: expected a file without --sweep")
    given, out = options.database, options.save_descriptors
    database = given and Database(given, model.fingerprints)
    if out and not out.parent.is_dir():
        raise ValueError(f"--save-descriptors: {out.parent} is no folder")
    files: dict[str, Path] = {}
    for frame, path in find_frames(options.source, model.suffixes):
        if frame in files:
            raise ValueError(f"{path} is a second frame {frame}")
        if out:
            require_one_line(frame)
        files[frame] = path
    seen: dict[str, Seen] = {}
    skipped = 0
    for frame, path in files.items():
        try:
            seen[frame] = model.see(path)
        except ValueError as error:
            note(f"{path}: {error}")
            skipped += 1
            continue
        [answer] = database.find([seen[frame]], top=options.top) if database else [None]
        report(frame, not seen[frame].descriptor.any(), answer, options.json)
    if out and seen:
        save(out, list(seen.values()), list(seen), model.fingerprints)
    return finished(skipped, len(seen))


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("source", type=Path, nargs="*", help="files or folders of frames")
    parser.add_argument("--database", type=Path, help=".npy file of reference descriptors")
    parser.add_argument("--top", type=int, default=5, help="candidates of each frame")
    parser.add_argument("--save-descriptors", type=Path, metavar="OUT.npy")
    parser.add_argument("--json", action="store_true", help="a JSON object a line")
    parser.add_argument("--check", action="store_true", help="run the golden pair and stop")
    options = parser.parse_args()
    usable = bool(options.source) != options.check and options.top > 0
    if options.model.exists() and not usable:
        parser.error("expected frames or --check, and --top of at least 1")
    return run_program("run_onnx", run, options)


if __name__ == "__main__":
    sys.exit(main())
