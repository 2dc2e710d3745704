#!/usr/bin/env python3
"""Describes frames with an exported or fused file, and finds them in an exported database.

python export/run_onnx.py head.onnx maps/today --database town.npy --top 3

Needs numpy and onnxruntime, nothing else; pictures need Pillow too, `.npy` arrays do not. Label
maps (H, W) go into a graph of `ssrvlad export`, class scores (C, H, W) as `.npy` into one made
with `--input logits`, images (H, W, 3) into one of `ssrvlad fuse`. A database is what
`ssrvlad db export --format npy` or --save-descriptors writes. Exit code 0 for success, 2 for wrong
use, 3 for finished with some frames skipped.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import re
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import onnxruntime

Array = npt.NDArray[Any]

SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")
TOLERANCE = 1e-6
SOME_SKIPPED = 3

_BLOCK = 1 << 14


class Described(NamedTuple):
    """``(D,)`` float32 of length 1, or zero for an empty frame, and ``(8,)`` int64 keypoints; of a
    file of `ssrvlad export --sweep` ``(S, D)``, a descriptor for each anchor."""

    descriptor: Array
    keypoints: Array


class Model:
    """A file of `ssrvlad export` or `ssrvlad fuse`, loaded on the CPU.

    Raises:
        ValueError: it is no such file.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        path.open("rb").close()
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        try:
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # what ONNX Runtime raises has no common base
            raise ValueError(f"{path}: {one_line(error)}") from error
        properties = self.session.get_modelmeta().custom_metadata_map
        if "ssrvlad.fingerprint" not in properties or "ssrvlad.label_space" not in properties:
            raise ValueError(
                f"{path}: no metadata ssrvlad.*: no file of `ssrvlad export` or `fuse`"
            )
        inputs = self.session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) not in (3, 4):
            names = ", ".join(f"{each.name} {each.shape}" for each in inputs)
            raise ValueError(f"{path}: expected one input of labels, scores or images, got {names}")
        self.properties = properties
        self.input = inputs[0]
        self.dtype = _dtype(inputs[0].type)

    @property
    def fingerprint(self) -> str:
        """Of the settings; descriptors of another do not compare."""
        return str(self.properties["ssrvlad.fingerprint"])

    @property
    def anchors(self) -> list[int]:
        """Columns of the anchors of a sweep; none for single descriptors."""
        return list(json.loads(self.properties.get("ssrvlad.interface", "{}")).get("sweep", []))

    def describe(self, path: Path) -> Described:
        """The frame in a file.

        Raises:
            ValueError: it cannot be read, or has ids outside the label space.
        """
        if len(self.input.shape) == 3:
            read: Callable[[Path], Array] = self._labels
        else:
            read = self._scores if self.input.name == "logits" else self._image
        try:
            given = read(path)
            descriptor, keypoints, unknown = self._run(given[None])
        except ImportError:
            raise
        except Exception as error:  # what decoders raise on damaged bytes has no bounds
            raise ValueError(one_line(error)) from error
        if unknown[0]:
            space = json.loads(self.properties["ssrvlad.label_space"])["name"]
            raise ValueError(
                f"{unknown[0]} of {given.shape[-2] * given.shape[-1]} pixels have an id outside "
                f"label space {space}"
            )
        return Described(descriptor[0], keypoints[0])

    def golden_difference(self) -> float:
        """Largest difference of the descriptors of the golden pair, infinite if a count differs.

        Raises:
            ValueError: the file has no golden pair for its input.
        """
        golden = json.loads(self.properties.get("ssrvlad.golden", "{}"))
        arrays = {name: _array(entry) for name, entry in golden.items()}
        if self.input.name not in arrays:
            raise ValueError(f"no golden pair for input {self.input.name}; see `ssrvlad verify`")
        descriptor, *counts = self._run(arrays[self.input.name])
        wanted = [arrays["keypoints"], arrays["unknown"]]
        if not all(np.array_equal(*pair) for pair in zip(counts, wanted, strict=True)):
            return float("inf")
        return float(np.abs(descriptor - arrays["descriptor"]).max())

    def _run(self, given: Array) -> list[Array]:
        names = ["descriptor", "keypoints", "unknown"]
        return list(self.session.run(names, {self.input.name: given}))

    def _labels(self, path: Path) -> Array:
        labels = _npy(path) if _is_npy(path) else _label_picture(path)
        if labels.ndim != 2 or labels.size == 0 or labels.dtype.kind not in "iu":
            raise ValueError(f"expected an (H, W) label map, got {labels.shape} {labels.dtype}")
        held = labels.astype(self.dtype)
        lost = int((held != labels).sum())
        if lost:
            raise ValueError(f"{lost} of {labels.size} pixels have an id that is no {self.dtype}")
        return held

    def _scores(self, path: Path) -> Array:
        scores = _npy(path)
        if scores.ndim != 3 or scores.dtype.kind != "f" or not np.isfinite(scores).all():
            raise ValueError(f"expected finite scores (C, H, W), got {scores.shape} {scores.dtype}")
        return scores.astype(self.dtype)

    def _image(self, path: Path) -> Array:
        pixels = _npy(path) if _is_npy(path) else _picture(path)
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
            raise ValueError(f"expected (H, W, 3) uint8, got {pixels.shape} {pixels.dtype}")
        return pixels


class Database:
    """Descriptors of reference frames in a `.npy` file, read as needed, and the frames' ids.

    The ids stand in ``FILE.frames.txt``, one a line, the fingerprint in ``FILE.fingerprint.txt``.

    Raises:
        ValueError: the files do not fit each other or the model.
        OSError: one cannot be read.
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        self.descriptors = np.load(path, mmap_mode="r", allow_pickle=False)
        self.frames = beside(path, "frames").read_text(encoding="utf-8").splitlines()
        if self.descriptors.ndim != 2 or len(self.descriptors) != len(self.frames):
            raise ValueError(f"{path}: {self.descriptors.shape} for {len(self.frames)} frames")
        if not beside(path, "fingerprint").exists():
            note(f"{path} carries no fingerprint: whether it fits the model cannot be checked")
        elif (own := beside(path, "fingerprint").read_text().strip()) != fingerprint:
            raise ValueError(
                f"{path} has fingerprint {own}, the model {fingerprint}: they do not compare"
            )

    def search(self, query: Array, top: int) -> list[tuple[str, float]]:
        """The frames with the highest cosines (Eq. 4), best first, the earlier of equals.

        Of several anchors the best counts. A zero vector, the descriptor of an empty frame,
        matches nothing.

        Raises:
            ValueError: the query is of another length.
        """
        anchors = query if query.ndim == 2 else query[None]
        if anchors.shape[1:] != self.descriptors.shape[1:]:
            raise ValueError(
                f"expected a database of {query.shape[-1]} numbers a frame, "
                f"got {self.descriptors.shape[1]}"
            )
        if not query.any():
            return []
        best: list[tuple[float, int]] = []
        for first in range(0, len(self.frames), _BLOCK):
            block = np.asarray(self.descriptors[first : first + _BLOCK], np.float32)
            norms = np.linalg.norm(block, axis=1)
            scores = (block @ anchors.T).max(1) / np.where(norms > 0, norms, 1)
            rows = np.flatnonzero(norms > 0)
            rows = rows[np.argsort(-scores[rows], kind="stable")[:top]]
            best += [(float(scores[row]), first + int(row)) for row in rows]
            best = sorted(best, key=lambda entry: (-entry[0], entry[1]))[:top]
        return [(self.frames[row], score) for score, row in best]


def find_frames(sources: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Frames, a file each, sorted as a person would, with their ids ``<folder>/<name>``.

    Raises:
        ValueError: a source does not exist or holds no frame.
    """
    for source in sources:
        files = [path for path in source.glob("[!.]*") if path.suffix.lower() in SUFFIXES]
        if source.is_file():
            files = [source]
        if not files:
            raise ValueError(f"{source} holds no frames; expected {', '.join(SUFFIXES)} files")
        for path in sorted(files, key=lambda path: _natural(path.stem)):
            yield f"{path.absolute().parent.name}/{path.stem}", path


def save(path: Path, descriptors: Sequence[Array], frames: Sequence[str], fingerprint: str) -> None:
    """Writes descriptors as a database: the array, ids and fingerprint beside it.

    The array, which says that the database is there, is written last and as a whole.
    """
    beside(path, "frames").write_text("".join(f"{frame}\n" for frame in frames), encoding="utf-8")
    beside(path, "fingerprint").write_text(f"{fingerprint}\n")
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            np.save(file, np.stack(descriptors))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def beside(path: Path, what: str) -> Path:
    """The file that says more about an array."""
    return path.with_name(f"{path.name}.{what}.txt")


def note(line: str) -> None:
    """One line on stderr."""
    print(line, file=sys.stderr)


def one_line(error: Exception) -> str:
    """An error in one line that is never empty."""
    return " ".join(str(error).split()) or type(error).__name__


def run(given: argparse.Namespace) -> int:
    """What the command line asks for; the exit code."""
    model = Model(given.model)
    if given.check:
        difference = model.golden_difference()
        print(f"largest difference for the golden pair: {difference:.3g}")
        return int(not difference <= TOLERANCE)
    if given.save_descriptors and model.anchors:
        raise ValueError("--save-descriptors: expected a file without --sweep, references have one")
    database = given.database and Database(given.database, model.fingerprint)
    kept: dict[str, Array] = {}
    skipped = 0
    for frame, path in find_frames(given.source):
        if frame in kept:
            raise ValueError(f"{path} is a second frame {frame}")
        try:
            described = model.describe(path)
        except ValueError as error:
            note(f"{path}: {error}")
            skipped += 1
            continue
        kept[frame] = described.descriptor
        candidates = database.search(described.descriptor, given.top) if database else []
        report(frame, described, candidates, given.json)
    if given.save_descriptors and kept:
        save(given.save_descriptors, list(kept.values()), list(kept), model.fingerprint)
    if skipped:
        note(f"skipped {skipped} of {skipped + len(kept)} frames")
    return SOME_SKIPPED if skipped else 0


def report(
    frame: str, described: Described, candidates: list[tuple[str, float]], as_json: bool
) -> None:
    """One line about a frame."""
    counts = described.keypoints.tolist()
    if as_json:
        ranked = [{"frame": name, "score": score} for name, score in candidates]
        empty = not described.descriptor.any()
        line = {"query": frame, "candidates": ranked, "keypoints": counts, "empty": empty}
        print(json.dumps(line))
    else:
        names = ", ".join(f"{name} {score:.4f}" for name, score in candidates)
        print(f"{frame}: {sum(counts)} keypoints" + (f"; {names}" if names else ""))


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, help="the .onnx file")
    parser.add_argument("source", type=Path, nargs="*", help="files or folders of frames")
    parser.add_argument("--database", type=Path, help=".npy file of reference descriptors")
    parser.add_argument("--top", type=int, default=5, help="candidates of each frame")
    parser.add_argument("--save-descriptors", type=Path, metavar="OUT.npy")
    parser.add_argument("--json", action="store_true", help="a JSON object a line")
    parser.add_argument("--check", action="store_true", help="run the golden pair and stop")
    given = parser.parse_args()
    if bool(given.source) == given.check or given.top < 1:
        parser.error("expected frames or --check, and --top of at least 1")
    try:
        return run(given)
    except (ValueError, OSError, ImportError) as error:
        note(f"run_onnx: {one_line(error)}")
        return 2


def _is_npy(path: Path) -> bool:
    return path.suffix.lower() == ".npy"


def _npy(path: Path) -> Array:
    return np.asarray(np.load(path, allow_pickle=False))


def _label_picture(path: Path) -> Array:
    """``(H, W)`` ids; of a palette image they are the indices."""
    with _opened(path) as image:
        stored = str(image.tile[0][3]) if image.tile else ""
        scaled = image.mode == "L" and ";" in stored
        if scaled or image.mode not in ("L", "P", "I", "I;16", "I;16B"):
            raise ValueError(
                f"expected gray (8 or 16 bits) or a palette, got {image.mode} {stored}"
            )
        return np.asarray(image)


def _picture(path: Path) -> Array:
    """``(H, W, 3)`` uint8 RGB, turned upright by its EXIF orientation."""
    with _opened(path) as image:
        from PIL import ImageOps

        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def _opened(path: Path) -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError("pictures need: pip install pillow; or give .npy arrays") from error
    return Image.open(path)


def _dtype(onnx_type: str) -> Any:
    """``tensor(uint8)`` -> ``uint8``."""
    name = onnx_type.removeprefix("tensor(").removesuffix(")")
    return np.dtype({"float": "float32", "double": "float64"}.get(name, name))


def _array(entry: dict[str, Any]) -> Array:
    """An array of the golden pair."""
    content = zlib.decompress(base64.b64decode(entry["data"]))
    dtype = np.dtype(entry["dtype"])
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype).reshape(entry["shape"])


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


if __name__ == "__main__":
    sys.exit(main())
