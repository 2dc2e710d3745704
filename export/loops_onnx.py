#!/usr/bin/env python3
"""Loop closures in a live stream with an exported or fused file: images in, loops out.

python export/loops_onnx.py place.onnx images/monday
your-camera | python export/loops_onnx.py place.onnx -

Prints a JSON object a line for every frame, as `ssrvlad loops --json` does: `frame`, `reason`,
`candidate`, `score`, `confidence`, `ahead`, `candidates`. `-` reads names of files on stdin, one a
line, and answers each at once. The rules and thresholds are those of `ssrvlad_torch.LoopDetector`:
with one anchor a frame, those of `ssrvlad loops --no-sweep`, and of a fused file, which gives all
channels, the same with the network. It needs what `run_onnx.py` needs. Exit code 0 for success, 2
for wrong use, 3 for finished with some frames skipped.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ssrvlad_place.model import LABEL_SHAPES, TRUST, Description, Model, add_model, open_model
from ssrvlad_place.output import finished, note, run_program

from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.native.loops import Channel, Loops, LoopStep


def stream_of(frame: Description, model: Model, config: LoopConfig) -> Loops:
    """A stream without frames, whose frames have the channels of this one."""
    channels = []
    for name, array in frame.channels.items():
        shape = array.shape[1:] if name == LABEL_SHAPES and model.anchors else array.shape
        channels.append(Channel(name, shape, str(array.dtype), TRUST[name]))
    return Loops(channels, config.exclude, config.threshold)


def line_of(frame: str, step: LoopStep, frames: list[str]) -> dict[str, Any]:
    """The result of a frame by the ids of the frames so far; without poses, none is ahead."""
    candidate = None if step.candidate is None else frames[step.candidate]
    places = [{"frame": frames[row], "confidence": likely} for row, likely in step.places]
    line = {"frame": frame, "reason": step.reason, "candidate": candidate, "score": step.score}
    return {**line, "confidence": step.probability, "ahead": None, "candidates": places}


def run(options: argparse.Namespace) -> int:
    """Runs the detector over a stream; the exit code."""
    model, config = open_model(options), LoopConfig(options.exclude, options.threshold)
    stream: Loops | None = None
    frames, ids, last, total = list[str](), set[str](), "", 0
    for file in model.frames(options.source):
        total += 1
        try:
            if file.frame in ids:
                raise ValueError(f"frame {file.frame} was there before")
            frame = model.see(file)
            if stream is None:
                stream = stream_of(frame, model, config)
            step = stream.update(frame.channels, starts=file.sequence != last)
        except ValueError as error:
            note(f"{file.location}: {error}")
            continue
        frames.append(file.frame)
        ids.add(file.frame)
        last = file.sequence
        print(json.dumps(line_of(file.frame, step, frames)), flush=True)
    return finished(total - len(frames), total)


def main() -> int:
    """The command line; errors are one line."""
    defaults = LoopConfig()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("source", type=Path, nargs="+", help="files or folders of frames, or -")
    parser.add_argument("--exclude", type=int, default=defaults.exclude)
    parser.add_argument("--threshold", type=float, default=defaults.threshold)
    options = parser.parse_args()
    if options.exclude < 0 or not 0 <= options.threshold <= 1:
        parser.error("expected --exclude from 0 and --threshold from 0 to 1")
    return run_program("loops_onnx", run, options)


if __name__ == "__main__":
    sys.exit(main())
