#!/usr/bin/env python3
"""Describes frames with an exported or fused file, and finds them in an exported database.

python export/run_onnx.py head.onnx maps/today --database town.npy --top 3
python export/run_onnx.py head.onnx photos --network net.onnx --provider CUDAExecutionProvider

Needs numpy and onnxruntime, and Pillow for pictures; `.npy` arrays do not need it. A file of
`ssrvlad export` takes label maps (H, W), or with `--input logits` class scores (C, H, W) as `.npy`;
a file of `ssrvlad fuse` takes images (H, W, 3). With the two files of `ssrvlad fuse --split` the
network runs on --provider and the head on the CPU. Every file is run on its golden pair when it is
loaded, and refused if this runtime gives other outputs. A database is written by `ssrvlad db export
--format npy` or by --save-descriptors. Where the file and the database have features, they are
fused with the descriptors of label maps. Each frame is judged alone, without the steps of `ssrvlad
query`; `follow_onnx.py` takes them for drives. Exit code 0 for success, 1 if --check finds the
golden pair wrong, 2 for wrong use, 3 for finished with some frames skipped.
"""

from __future__ import annotations

import argparse
import base64
import json
import math
import os
import re
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import onnxruntime

Array = npt.NDArray[Any]

SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")
CPU = "CPUExecutionProvider"
FORMAT = "2"
TOLERANCE = 1e-6
SOME_SKIPPED = 3

MAX_OTHER_PIXELS = 0.01
"""Fraction of a golden image's pixels whose label may differ on another runtime."""
MIN_COSINE = 0.8
"""Cosine of the descriptors of two label maps that differ so little; unlike maps have less."""
MAX_OTHER_SIGNS = 0.01
"""Fraction of the signs of a golden image's features that may differ on another runtime."""

WEIGHTS = (1 / 7, 6 / 7)
"""Of label maps and of features, as `ssrvlad query` weighs them for single frames."""
REACH = 2
"""Columns of cells by which features are moved to each side."""

_BLOCK, _SIGNS_BLOCK = 1 << 14, 1 << 10
_ONES = np.unpackbits(np.arange(1 << 16, dtype=np.uint16).view(np.uint8)).reshape(-1, 16).sum(1)
_ROUNDING = 1e-6
_MAX_ID, _MIN_EVEN = 40, 0.8
_MAX_GOLDEN_BYTES = 64 << 20
_NPY = b"\x93NUMPY"
_ONLY_FATAL = 4


class Seen(NamedTuple):
    """A frame: its descriptor, see `Model.describe`, and its features ``(16, 16, 8)`` uint8, or
    ``None`` if the file gives none."""

    descriptor: Array
    features: Array | None = None


class Golden(NamedTuple):
    """The result of a golden pair: the largest difference of the descriptor, infinite if a count
    differs; the fraction of pixels with another label; the cosine to the expected descriptor; the
    fraction of other signs."""

    difference: float
    other_pixels: float = 0.0
    cosine: float = 1.0
    other_signs: float = 0.0

    def __str__(self) -> str:
        other = f", {self.other_pixels:.2%} of the labels differ" if self.other_pixels else ""
        other += f", {self.other_signs:.2%} of the features differ" if self.other_signs else ""
        return f"largest difference for the golden pair: {self.difference:.3g}{other}"

    @property
    def holds(self) -> bool:
        """Whether the runtime can be trusted. Where some labels differ, the descriptor differs too,
        so only a large error of the head is found."""
        is_similar = self.other_pixels > 0 and self.cosine >= MIN_COSINE
        is_right = self.difference <= TOLERANCE or is_similar
        is_near = self.other_pixels <= MAX_OTHER_PIXELS and self.other_signs <= MAX_OTHER_SIGNS
        return is_near and is_right


class Model:
    """A file of `ssrvlad export` or `ssrvlad fuse`, loaded.

    Args:
        path: the file.
        provider: execution provider of ONNX Runtime; operators that it lacks run on the CPU.
        check: whether to run the golden pair and refuse a runtime that gives other outputs.

    Raises:
        ValueError: the file is of another kind or format, or its golden pair gives other outputs.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, provider: str = CPU, check: bool = True) -> None:
        self.session = _session(path, provider)
        self.properties = _properties(path, self.session)
        self.input = _input(path, self.session)
        self.dtype = _dtype(self.input.type)
        if check:
            _require_golden(path, self.golden())

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the settings; descriptors of another one do not compare."""
        return str(self.properties["ssrvlad.fingerprint"])

    @property
    def features(self) -> str:
        """Fingerprint of the features that the file gives, or ``""``."""
        return self.properties.get("ssrvlad.features", "")

    @property
    def anchors(self) -> list[int]:
        """Columns of the anchors of a sweep; empty for single descriptors."""
        return list(json.loads(self.properties.get("ssrvlad.interface", "{}")).get("sweep", []))

    def describe(self, path: Path) -> Array:
        """The descriptor of the frame in a file: ``(D,)`` float32 of length 1, or zeros for an
        empty frame; with `ssrvlad export --sweep` ``(S, D)``, one for each anchor.

        Raises:
            ValueError: it cannot be read, or has ids outside the label space.
        """
        return self.see(path).descriptor

    def see(self, path: Path) -> Seen:
        """The descriptor and the features of the frame in a file; errors as of `describe`."""
        if len(self.input.shape) == 3:
            read: Callable[[Path], Array] = self._labels
        else:
            read = self._scores if self.input.name == "logits" else self._image
        try:
            return self.see_array(read(path))
        except ImportError:
            raise
        except Exception as error:  # decoders raise anything on damaged bytes
            raise ValueError(one_line(error)) from error

    def describe_array(self, array: Array) -> Array:
        """The descriptor of a frame in memory: the input of the file without the batch axis.

        Raises:
            ValueError: it has ids outside the label space, more than the file can count, or another
                size than the fixed size of the file; or the network sees nothing in it.
        """
        return self.see_array(array).descriptor

    def see_array(self, array: Array) -> Seen:
        """The descriptor and the features of a frame in memory; errors as of `describe_array`."""
        expected, shape = self.input.shape, (1, *array.shape)
        if any(isinstance(n, int) and n != m for n, m in zip(expected, shape, strict=True)):
            raise ValueError(f"the file takes {self.input.name} of {tuple(expected)}, got {shape}")
        descriptor, unknown, *features = self._run(array[None])
        if unknown[0]:
            space = json.loads(self.properties["ssrvlad.label_space"])["name"]
            channels = {"labels": 1, "logits": array.shape[0]}.get(self.input.name, 3)
            raise ValueError(
                f"{unknown[0]} of {array.size // channels} pixels have an id outside label space "
                f"{space}"
            )
        if not np.isfinite(descriptor).all():
            raise ValueError(
                "the frame is too wide, or has too many keypoints, for an exported file"
            )
        if features and not features[0].any():
            raise ValueError(
                "the activations of the network are not finite, or the same everywhere"
            )
        return Seen(np.asarray(descriptor[0]), features[0][0] if features else None)

    def golden(self) -> Golden:
        """Runs the golden pair.

        Raises:
            ValueError: the file has no golden pair for its input, or cannot run it.
        """
        return _golden(self.session, self.input.name, self.properties)

    def _run(self, batch: Array) -> list[Array]:
        names = ["descriptor", "unknown", *["features"] * bool(self.features)]
        return list(self.session.run(names, {self.input.name: batch}))

    def _labels(self, path: Path) -> Array:
        classes = json.loads(self.properties["ssrvlad.label_space"])["classes"]
        labels = _npy(path) if _is_npy(path) else _label_picture(path, classes)
        if labels.ndim != 2 or labels.size == 0 or labels.dtype.kind not in "iu":
            raise ValueError(f"expected an (H, W) label map, got {labels.shape} {labels.dtype}")
        converted = labels.astype(self.dtype)
        changed = int((converted != labels).sum())
        if changed:
            raise ValueError(f"{changed} of {labels.size} pixels have an id outside {self.dtype}")
        return converted

    def _scores(self, path: Path) -> Array:
        if not _is_npy(path):
            raise ValueError("expected scores (C, H, W) in a .npy file, got another kind of file")
        scores = _npy(path)
        if scores.ndim != 3 or scores.dtype.kind != "f" or not np.isfinite(scores).all():
            raise ValueError(f"expected finite scores (C, H, W), got {scores.shape} {scores.dtype}")
        return scores.astype(self.dtype)

    def _image(self, path: Path) -> Array:
        pixels = _npy(path) if _is_npy(path) else _picture(path)
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
            raise ValueError(f"expected (H, W, 3) uint8, got {pixels.shape} {pixels.dtype}")
        return pixels


class Split(Model):
    """The two files of `ssrvlad fuse --split`: the network on a provider, the head on the CPU. The
    label map is not copied between them, except once from a GPU.

    Args:
        network: pictures to label maps.
        head: label maps to descriptors.
        provider: execution provider of the network.
        check: as for `Model`, for both files.

    Raises:
        ValueError: as `Model`, or the files were not written together.
        OSError: a file cannot be read.
    """

    def __init__(self, network: Path, head: Path, provider: str = CPU, check: bool = True) -> None:
        super().__init__(head, CPU, check=False)
        self.network = _session(network, provider)
        self.network_properties = _properties(network, self.network)
        for name in ("ssrvlad.fingerprint", "ssrvlad.label_space"):
            if self.network_properties[name] != self.properties[name]:
                raise ValueError(f"{network} and {head} differ in {name}: expected the two files")
        labels, self.input = self.input, _input(network, self.network)
        outputs = [(output.name, output.type) for output in self.network.get_outputs()]
        if outputs[:1] != [("labels", labels.type)] or labels.name != "labels":
            raise ValueError(f"{network} gives {outputs}, {head} takes {labels.name} {labels.type}")
        if check:
            golden = self.golden()
            _require_golden(network if golden.difference <= TOLERANCE else head, golden)

    @property
    def features(self) -> str:
        """As of `Model`; the file of the network gives them."""
        return self.network_properties.get("ssrvlad.features", "")

    def golden(self) -> Golden:
        """Runs the golden pairs of both files."""
        head = _golden(self.session, "labels", self.properties)
        network = _golden(self.network, "image", self.network_properties)
        others = {"other_pixels": network.other_pixels, "other_signs": network.other_signs}
        return head._replace(**others) if head.holds else head

    def _run(self, batch: Array) -> list[Array]:
        image = onnxruntime.OrtValue.ortvalue_from_numpy(batch)
        names = ["labels", *["features"] * bool(self.features)]
        labels, *features = self.network.run_with_ort_values(names, {"image": image})
        outputs = self.session.run_with_ort_values(["descriptor", "unknown"], {"labels": labels})
        return [output.numpy() for output in [*outputs, *features]]


def open_model(options: argparse.Namespace) -> Model:
    """The model that the command line names."""
    check = not (options.unchecked or getattr(options, "check", False))
    if options.network:
        return Split(options.network, options.model, options.provider, check)
    return Model(options.model, options.provider, check)


def add_model(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments that `open_model` reads."""
    parser.add_argument("model", type=Path, help="the .onnx file")
    parser.add_argument("--network", type=Path, help="network file of `fuse --split`")
    parser.add_argument("--provider", default=CPU, help="of the network, or of a single file")
    parser.add_argument("--unchecked", action="store_true", help="do not run the golden pair first")


class Database:
    """Descriptors of reference frames in a `.npy` file, read block by block, and the frames' ids.

    ``FILE.frames.txt`` holds the ids, one a line, ``FILE.fingerprint.txt`` the fingerprint, and
    ``FILE.features.npy`` features, with a fingerprint of their own.

    Args:
        path: FILE.
        fingerprint: of the model.
        features: fingerprint of its features; empty without.

    Raises:
        ValueError: the files do not fit each other or the model.
        OSError: a file cannot be read.
    """

    def __init__(self, path: Path, fingerprint: str, features: str = "") -> None:
        self.descriptors, self.signs = _rows(path, fingerprint, 2), None
        signs = path.with_name(f"{path.name}.features.npy")
        if bool(features) != signs.exists():
            which = "the model" if features else path
            note(f"only {which} has features: frames are matched by their label maps alone")
        elif features:
            self.signs = _rows(signs, features, 4)
        self.frames = beside(path, "frames").read_text(encoding="utf-8").splitlines()
        for rows in (self.descriptors, self.signs):
            if rows is not None and len(rows) != len(self.frames):
                raise ValueError(f"{path}: {rows.shape} for {len(self.frames)} frames")

    def search(
        self, query: Array, top: int, features: Array | None = None
    ) -> list[tuple[str, float]]:
        """The frames with the highest scores, best first; of equal ones the earlier first.

        A score is a cosine (Eq. 4), of several anchors the best one, with features in the query
        and in the database a fused score, see `fused`. A zero vector, the descriptor of an empty
        frame, matches nothing.

        Raises:
            ValueError: the query has another length.
        """
        scores = self._cosines(query)
        if features is not None and self.signs is not None:
            scores = fused([scores, self._cosines_of_signs(features)], WEIGHTS)
        rows = np.flatnonzero(np.isfinite(scores))
        rows = rows[np.argsort(-scores[rows], kind="stable")[:top]]
        return [(self.frames[row], float(scores[row])) for row in rows]

    def _cosines(self, query: Array) -> Array:
        """``(R,)`` float32, -inf where a vector is zero."""
        anchors = query if query.ndim == 2 else query[None]
        if anchors.shape[1:] != self.descriptors.shape[1:]:
            raise ValueError(
                f"expected a database of {query.shape[-1]} numbers a frame, "
                f"got {self.descriptors.shape[1]}"
            )
        cosines = np.full(len(self.frames), -np.inf, np.float32)
        for first in range(0, len(cosines) if query.any() else 0, _BLOCK):
            block = np.asarray(self.descriptors[first : first + _BLOCK], np.float32)
            norms, products = np.linalg.norm(block, axis=1), (block @ anchors.T).max(1)
            np.divide(products, norms, out=cosines[first : first + len(block)], where=norms > 0)
        return cosines

    def _cosines_of_signs(self, query: Array) -> Array:
        """``(R,)`` float32, of the columns of cells that overlap, for the best of all moves."""
        assert self.signs is not None
        cosines = np.full(len(self.frames), -1, np.float32)
        columns = len(query)
        for first in range(0, len(cosines), _SIGNS_BLOCK):
            block = np.asarray(self.signs[first : first + _SIGNS_BLOCK])
            best = cosines[first : first + len(block)]
            for move in range(-REACH, REACH + 1):
                ours = query[max(0, -move) : columns - max(0, move)]
                theirs = block[:, max(0, move) : columns - max(0, -move)]
                words = np.ascontiguousarray(theirs ^ ours).reshape(len(block), -1).view(np.uint16)
                different = _ONES[words].sum(1) / np.float32(4 * ours.size)
                np.maximum(best, np.float32(1) - different.astype(np.float32), out=best)
        return cosines


def find_frames(sources: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Ids ``<folder>/<name>`` and files of frames, in natural order.

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


def _rows(path: Path, fingerprint: str, axes: int) -> Array:
    """An array of frames with a fingerprint."""
    try:
        rows = _npy(path, "r")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if rows.ndim != axes:
        raise ValueError(f"{path}: expected an array of {axes} axes, got {rows.shape}")
    if not beside(path, "fingerprint").exists():
        note(f"{path} has no fingerprint: it may not fit the model")
    elif (own := beside(path, "fingerprint").read_text().strip()) != fingerprint:
        raise ValueError(
            f"{path} has fingerprint {own}, the model {fingerprint}: they do not compare"
        )
    return rows


def fused(scores: Sequence[Array], weights: Sequence[float]) -> Array:
    """``(R,)`` scores of one query by several methods as one, by the rule of `ssrvlad query`: the
    weighted means of their z-scores of nearness, minus the logarithm of 1 - cosine. -inf where no
    method has a score."""
    parts = []
    for each, weight in zip(scores, weights, strict=True):
        known = np.isfinite(each)
        near = np.where(known, -np.log(np.maximum(1 - each, np.float32(_ROUNDING))), 0)
        count = max(1, np.count_nonzero(known))
        mean = near.sum() / count
        centred = np.where(known, near - mean, 0)
        spread = np.sqrt(np.square(centred).sum() / count)
        parts.append((weight * centred / max(spread, _ROUNDING), weight * mean, weight * spread))
    z, mean, spread = (sum(part) for part in zip(*parts, strict=True))
    none = ~np.isfinite(scores).any(0)
    return np.where(none, -np.inf, -np.expm1(-(mean + spread * z)))


def save(
    path: Path,
    seen: Sequence[Seen],
    frames: Sequence[str],
    fingerprint: str,
    features: str = "",
) -> None:
    """Writes frames as a database: the arrays, and files with ids and fingerprints beside them.

    The array of descriptors is written last, every array whole or not at all.

    Args:
        path: the array of descriptors.
        seen: the frames.
        frames: their ids.
        fingerprint: of the descriptors.
        features: fingerprint of the features, if the frames have some.

    Raises:
        ValueError: an id has several lines.
        OSError: a file cannot be written.
    """
    for frame in frames:
        _require_one_line(frame)
    beside(path, "frames").write_text("".join(f"{frame}\n" for frame in frames), encoding="utf-8")
    signs = path.with_name(f"{path.name}.features.npy")
    signs.unlink(missing_ok=True)
    if features:
        _save(signs, [each.features for each in seen], features)
    _save(path, [each.descriptor for each in seen], fingerprint)


def _save(path: Path, rows: Sequence[Any], fingerprint: str) -> None:
    beside(path, "fingerprint").write_text(f"{fingerprint}\n")
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            np.save(file, np.stack(rows))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def beside(path: Path, what: str) -> Path:
    """A text file that belongs to an array."""
    return path.with_name(f"{path.name}.{what}.txt")


def note(line: str) -> None:
    """Prints one line on stderr."""
    print(line, file=sys.stderr)


def one_line(error: Exception) -> str:
    """The message of an error as one line, never empty."""
    return " ".join(str(error).split()) or type(error).__name__


def run(options: argparse.Namespace) -> int:
    """Runs the program; the exit code."""
    model = open_model(options)
    if options.check:
        golden = model.golden()
        print(golden)
        return int(not golden.holds)
    if options.save_descriptors and model.anchors:
        raise ValueError("--save-descriptors: expected a file without --sweep")
    given = options.database
    database = given and Database(given, model.fingerprint, model.features)
    seen: dict[str, Seen] = {}
    skipped = 0
    for frame, path in find_frames(options.source):
        if frame in seen:
            raise ValueError(f"{path} is a second frame {frame}")
        if options.save_descriptors:
            _require_one_line(frame)
        try:
            seen[frame] = model.see(path)
        except ValueError as error:
            note(f"{path}: {error}")
            skipped += 1
            continue
        descriptor, features = seen[frame]
        candidates = database.search(descriptor, options.top, features) if database else []
        report(frame, not descriptor.any(), candidates, options.json)
    if options.save_descriptors and seen:
        rows, frames = list(seen.values()), list(seen)
        save(options.save_descriptors, rows, frames, model.fingerprint, model.features)
    if skipped:
        note(f"skipped {skipped} of {skipped + len(seen)} frames")
    return SOME_SKIPPED if skipped else 0


def report(frame: str, empty: bool, candidates: list[tuple[str, float]], as_json: bool) -> None:
    """Prints one line about a frame."""
    if as_json:
        ranked = [{"frame": name, "score": score} for name, score in candidates]
        print(json.dumps({"query": frame, "candidates": ranked, "empty": empty}))
    else:
        names = ", ".join(f"{name} {score:.4f}" for name, score in candidates)
        print(f"{frame}: " + ("empty" if empty else names or "described"))


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
    if bool(options.source) == options.check or options.top < 1:
        parser.error("expected frames or --check, and --top of at least 1")
    try:
        return run(options)
    except (ValueError, OSError, ImportError) as error:
        note(f"run_onnx: {one_line(error)}")
        return 2


def _session(path: Path, provider: str) -> Any:
    path.open("rb").close()
    available = onnxruntime.get_available_providers()
    if provider not in available:
        raise ValueError(f"no provider {provider}; expected one of {', '.join(available)}")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ONLY_FATAL
    providers = [*dict.fromkeys((provider, CPU))]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # ONNX Runtime has no common error type
        raise ValueError(f"{path}: {one_line(error)}") from error


def _properties(path: Path, session: Any) -> dict[str, str]:
    properties = dict(session.get_modelmeta().custom_metadata_map)
    if "ssrvlad.fingerprint" not in properties or "ssrvlad.label_space" not in properties:
        raise ValueError(f"{path}: no metadata ssrvlad.*: not a file of `ssrvlad export` or `fuse`")
    number = properties.get("ssrvlad.format", "1")
    if number != FORMAT:
        raise ValueError(f"{path}: a file of format {number}; expected {FORMAT}: export it again")
    return properties


def _input(path: Path, session: Any) -> Any:
    inputs = session.get_inputs()
    if len(inputs) != 1 or len(inputs[0].shape) not in (3, 4):
        names = ", ".join(f"{each.name} {each.shape}" for each in inputs)
        raise ValueError(f"{path}: expected one input of labels, scores or images, got {names}")
    return inputs[0]


def _golden(session: Any, name: str, properties: dict[str, str]) -> Golden:
    """Runs the golden pair of a file.

    Args:
        session: the session of the file.
        name: name of its input.
        properties: its metadata.

    Raises:
        ValueError: it has none for the input, or cannot be run.
    """
    entries = json.loads(properties.get("ssrvlad.golden", "{}"))
    try:
        golden = {key: _array(entry) for key, entry in entries.items()}
    except (KeyError, TypeError, zlib.error) as error:
        raise ValueError(f"the golden pair is damaged: {one_line(error)}") from error
    if name not in golden:
        raise ValueError(f"no golden pair for input {name}; see `ssrvlad verify`")
    inputs = {name: golden.pop(name)}
    try:
        outputs = dict(zip(golden, session.run(list(golden), inputs), strict=True))
    except Exception as error:  # ONNX Runtime has no common error type
        raise ValueError(f"cannot run the golden pair: {one_line(error)}") from error
    if any(outputs[key].shape != array.shape for key, array in golden.items()):
        return Golden(float("inf"), cosine=0.0)
    other = float((outputs["labels"] != golden["labels"]).mean()) if "labels" in golden else 0.0
    signs = [each["features"] for each in (outputs, golden) if "features" in golden]
    others = float(np.unpackbits(signs[0] ^ signs[1]).mean()) if signs else 0.0
    if "descriptor" not in golden:
        return Golden(0.0, other, other_signs=others)
    got, expected = outputs["descriptor"], golden["descriptor"]
    counts = golden.keys() - {"descriptor", "labels", "features"}
    equal = all(np.array_equal(outputs[key], golden[key]) for key in counts)
    steps = np.nan_to_num(np.abs(got - expected), nan=np.inf)
    cosine = np.nan_to_num((got * expected).sum(-1)).min()
    return Golden(float(steps.max()) if equal else float("inf"), other, float(cosine), others)


def _require_golden(path: Path, golden: Golden) -> None:
    """Refuses a runtime whose golden pair is wrong."""
    if not golden.holds:
        raise ValueError(
            f"{path} is computed wrong here ({golden}); `ssrvlad verify --provider` says where, "
            "--unchecked runs it anyway"
        )
    if golden.difference > TOLERANCE:
        note(f"{path}: {golden}: the head was checked roughly; `ssrvlad verify` checks it exactly")


def _require_one_line(frame: str) -> None:
    """Refuses an id of several lines: a database has one id a line."""
    if frame.splitlines() != [frame]:
        raise ValueError(f"a database has one id a line; frame {frame!r} has several lines")


def _is_npy(path: Path) -> bool:
    return path.suffix.lower() == ".npy"


def _npy(path: Path, mmap_mode: Literal["r"] | None = None) -> Array:
    """The array in a `.npy` file.

    Raises:
        ValueError: the file holds something else.
    """
    with path.open("rb") as file:
        if file.read(len(_NPY)) != _NPY:
            raise ValueError("expected an array in a .npy file, got another kind of file")
    return np.asanyarray(np.load(path, mmap_mode, allow_pickle=False))


def _label_picture(path: Path, classes: list[dict[str, Any]]) -> Array:
    """``(H, W)`` ids; of a palette image see `_ids_of_palette`."""
    with _open_image(path) as image:
        stored = str(image.tile[0][3]) if image.tile else ""
        scaled = image.mode == "L" and ";" in stored
        if scaled or image.mode not in ("L", "P", "I", "I;16", "I;16B"):
            raise ValueError(
                f"expected gray (8 or 16 bits) or a palette, got {image.mode} {stored}"
            )
        pixels = np.asarray(image)
        return _ids_of_palette(pixels, image.getpalette(), classes) if image.mode == "P" else pixels


def _ids_of_palette(indices: Array, colours: list[int], classes: list[dict[str, Any]]) -> Array:
    """The rule of `ssrvlad encode`: ids are the indices, unless the palette shows other ids."""
    known = sorted((each for each in classes if each.get("colour")), key=lambda each: each["id"])
    ids = {tuple(each["colour"]): each["id"] for each in known}
    own = {each["id"]: tuple(each["colour"]) for each in known}
    shown = {int(i): tuple(colours[3 * i : 3 * i + 3]) for i in np.unique(indices).tolist()}
    others = [i for i, colour in shown.items() if colour != own.get(i, (0, 0, 0))]
    moved = {i: ids[shown[i]] for i in others if shown[i] in ids}
    strays = [i for i in others if i not in moved]
    unclear = strays if moved else []
    if all(len(set(colour)) == 1 for colour in shown.values()):
        is_id = strays and all(colour == (i, i, i) for i, colour in shown.items())
        moved, unclear = {}, [] if is_id else others
    if unclear:
        raise ValueError(
            f"the palette shows index {unclear[0]} as {shown[unclear[0]]}; expected colours of the "
            "label space alone, or an image without palette, to tell which is the id"
        )
    table = np.arange(256)
    table[list(moved)] = list(moved.values())
    return table[indices]


def _picture(path: Path) -> Array:
    """``(H, W, 3)`` uint8 RGB, turned upright by its EXIF orientation."""
    with _open_image(path) as image:
        from PIL import ImageOps

        if image.mode in ("L", "P"):
            _require_photograph(np.asarray(image))
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def _require_photograph(values: Array) -> None:
    """Refuses a label map: small ids, or 255, in even areas. A dark photograph has noise."""
    ids = np.setdiff1d(values, [255])
    is_even = np.mean(values[:, 1:] == values[:, :-1]) > _MIN_EVEN
    if len(ids) > 1 and ids[-1] <= _MAX_ID and is_even:
        raise ValueError(
            f"expected a photograph, got a label map: {len(ids)} values, {ids[0]} to {ids[-1]}"
        )


def _open_image(path: Path) -> Any:
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
    dtype = np.dtype(entry["dtype"])
    size = dtype.itemsize * math.prod(entry["shape"])
    if not 0 <= size <= _MAX_GOLDEN_BYTES:
        raise ValueError(f"the golden pair has an array of {size} bytes; expected at most 64 MiB")
    content = zlib.decompressobj().decompress(base64.b64decode(entry["data"]), size + 1)
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype).reshape(entry["shape"])


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


if __name__ == "__main__":
    sys.exit(main())
