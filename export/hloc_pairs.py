#!/usr/bin/env python3
"""Writes image pairs for hloc and COLMAP from results of `ssrvlad`: a line "query reference" each.

ssrvlad query town.ssrdb images/today --top 20 --json | \\
    python export/hloc_pairs.py --images images -o pairs.txt

Reads JSON lines on stdin. Lines of `ssrvlad query --json` and `export/run_onnx.py --json` give a
pair for each candidate, best first; lines of `ssrvlad loops --json` and `export/loops_onnx.py` give
a pair for each accepted loop. The file has the form of `hloc.pairs_from_retrieval`, for
`hloc.match_features`, `hloc.localize_sfm` and COLMAP's `matches_importer`. Both name an image by
its path below the folder `--images`, with suffix; without `--images`, frames are named by their
ids, as in `ssrvlad db export --format hloc`. Needs Python only.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")
ACCEPTED = "accepted"

Pair = tuple[str, str]


class ImageNames:
    """The name that hloc has for each frame: its file's path below a folder.

    Args:
        folder: of all images, also in subfolders; the image of a frame ``monday/left/000042`` is
            the only one whose path without suffix ends with this id.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._paths: dict[str, list[Path]] = {}
        for path in sorted(folder.rglob("*")):
            if path.suffix.lower() in SUFFIXES:
                self._paths.setdefault(path.stem, []).append(path)

    def __getitem__(self, frame: str) -> str:
        """The name of a frame.

        Raises:
            ValueError: there is not exactly one such image.
        """
        names = [
            path.relative_to(self.folder).as_posix()
            for path in self._paths.get(frame.rpartition("/")[2], [])
            if path.absolute().with_suffix("").as_posix().endswith(f"/{frame}")
        ]
        if len(names) != 1:
            matches = " and ".join(names) or "none"
            raise ValueError(
                f"expected one image of frame {frame!r} in {self.folder}, got {matches}"
            )
        return names[0]


def pairs_of(lines: Iterable[str]) -> Iterator[Pair]:
    """Ids of frames and of their candidates.

    Raises:
        ValueError: a line has another form; the message has its number.
    """
    for number, line in enumerate(lines, 1):
        try:
            result: dict[str, Any] = json.loads(line)
            if "reason" in result:
                if result["reason"] == ACCEPTED:
                    yield result["frame"], result["candidate"]
            elif "candidates" in result:
                yield from ((result["query"], place["frame"]) for place in result["candidates"])
            elif "precision" not in result:
                raise KeyError("candidates")
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"line {number}: expected JSON of `ssrvlad query --json` or `loops --json`, "
                f"got {line.strip()[:60]!r}"
            ) from error


def write_pairs(path: Path, pairs: Iterable[Pair]) -> int:
    """Writes pairs as `hloc.pairs_from_retrieval` does, and returns their number.

    Raises:
        ValueError: a name has white space, which separates the two names in the file.
    """
    lines = []
    for pair in pairs:
        for name in pair:
            if len(name.split()) != 1:
                raise ValueError(f"hloc cannot read a name with white space, got {name!r}")
        lines.append(" ".join(pair))
    path.write_text("\n".join(lines), encoding="utf-8")
    return len(lines)


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, help="the folder that hloc is given as images")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PAIRS.txt")
    options = parser.parse_args()
    try:
        pairs = list(pairs_of(sys.stdin))
        if options.images:
            names = ImageNames(options.images)
            pairs = [(names[query], names[reference]) for query, reference in pairs]
        print(f"{write_pairs(options.output, pairs)} pairs: {options.output}")
    except (ValueError, OSError) as error:
        print(f"hloc_pairs: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
