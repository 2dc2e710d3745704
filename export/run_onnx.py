#!/usr/bin/env python3
"""Describes frames with an exported or fused file, and finds them in an exported database.

python export/run_onnx.py head.onnx maps/today --database town.npy --top 3
python export/run_onnx.py head.onnx photos --network net.onnx --provider CUDAExecutionProvider

Needs numpy and onnxruntime, nothing else; pictures need Pillow too, `.npy` arrays do not. Label
maps (H, W) go into a graph of `ssrvlad export`, class scores (C, H, W) as `.npy` into one made
with `--input logits`, images (H, W, 3) into one of `ssrvlad fuse`. With the two files of `ssrvlad
fuse --split` the network runs where --provider says and the head on the CPU. Every file runs its
golden pair as it is loaded, and one that gives something else on this runtime is refused. A
database is what `ssrvlad db export --format npy` or --save-descriptors writes. Exit code 0 for
success, 1 for a golden pair that --check finds wrong, 2 for wrong use, 3 for finished with some
frames skipped.
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

MOST_OTHER_PIXELS = 0.01
"""Fraction of a golden image's pixels that may get another label on another runtime."""
LEAST_COSINE = 0.8
"""Of the descriptors of two label maps that differ so little; other maps have less."""

_BLOCK = 1 << 14
_HIGHEST_ID, _EVEN = 40, 0.8
_MOST_GOLDEN = 64 << 20
_NPY = b"\x93NUMPY"
_ONLY_FATAL = 4


class Golden(NamedTuple):
    """How the golden pair came out: the largest difference of a descriptor, infinite if a count
    differs; the fraction of the pixels that got another label; the cosine to what is expected."""

    difference: float
    other_pixels: float = 0.0
    cosine: float = 1.0

    def __str__(self) -> str:
        other = f", {self.other_pixels:.2%} of the labels differ" if self.other_pixels else ""
        return f"largest difference for the golden pair: {self.difference:.3g}{other}"

    @property
    def holds(self) -> bool:
        """Whether the runtime can be trusted. Where the network labels some pixels otherwise, the
        descriptor is another too, and only a gross fault of the head shows."""
        roughly = self.other_pixels > 0 and self.cosine >= LEAST_COSINE
        return self.other_pixels <= MOST_OTHER_PIXELS and (self.difference <= TOLERANCE or roughly)


class Model:
    """A file of `ssrvlad export` or `ssrvlad fuse`, loaded.

    Args:
        path: the file.
        provider: execution provider of ONNX Runtime; what it lacks runs on the CPU.
        check: whether to run the golden pair and refuse a runtime that gives something else.

    Raises:
        ValueError: it is no such file or of another format, or the golden pair comes out otherwise.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, provider: str = CPU, check: bool = True) -> None:
        self.session = _session(path, provider)
        self.properties = _properties(path, self.session)
        self.input = _input(path, self.session)
        self.dtype = _dtype(self.input.type)
        if check:
            _refuse_unless_right(path, self.golden())

    @property
    def fingerprint(self) -> str:
        """Of the settings; descriptors of another do not compare."""
        return str(self.properties["ssrvlad.fingerprint"])

    @property
    def anchors(self) -> list[int]:
        """Columns of the anchors of a sweep; none for single descriptors."""
        return list(json.loads(self.properties.get("ssrvlad.interface", "{}")).get("sweep", []))

    def describe(self, path: Path) -> Array:
        """The descriptor of the frame in a file: ``(D,)`` float32 of length 1, or zero for an empty
        frame; of a file of `ssrvlad export --sweep` ``(S, D)``, one for each anchor.

        Raises:
            ValueError: it cannot be read, or has ids outside the label space.
        """
        if len(self.input.shape) == 3:
            read: Callable[[Path], Array] = self._labels
        else:
            read = self._scores if self.input.name == "logits" else self._image
        try:
            return self.describe_array(read(path))
        except ImportError:
            raise
        except Exception as error:  # what decoders raise on damaged bytes has no bounds
            raise ValueError(one_line(error)) from error

    def describe_array(self, given: Array) -> Array:
        """That of a frame in memory, as the file takes it, without the axis of the batch.

        Raises:
            ValueError: it has ids outside the label space, more than the file can count, or another
                size than the file takes.
        """
        takes, shape = self.input.shape, (1, *given.shape)
        if any(isinstance(n, int) and n != m for n, m in zip(takes, shape, strict=True)):
            raise ValueError(f"the file takes {self.input.name} of {tuple(takes)}, got {shape}")
        descriptor, unknown = self._run(given[None])
        if unknown[0]:
            space = json.loads(self.properties["ssrvlad.label_space"])["name"]
            channels = {"labels": 1, "logits": given.shape[0]}.get(self.input.name, 3)
            raise ValueError(
                f"{unknown[0]} of {given.size // channels} pixels have an id outside label space "
                f"{space}"
            )
        if not np.isfinite(descriptor).all():
            raise ValueError(
                "the frame is too wide, or has too many keypoints, for an exported file"
            )
        return np.asarray(descriptor[0])

    def golden(self) -> Golden:
        """Runs the golden pair.

        Raises:
            ValueError: the file has no golden pair for its input, or it cannot be run.
        """
        return _golden(self.session, self.input.name, self.properties)

    def _run(self, given: Array) -> list[Array]:
        return list(self.session.run(["descriptor", "unknown"], {self.input.name: given}))

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
    """The two files of `ssrvlad fuse --split`: the network where a provider runs it, the head on
    the CPU. The label map goes from one to the other as it lies in memory; from a GPU it is
    fetched once.

    Args:
        network: pictures to label maps.
        head: label maps to descriptors.
        provider: of the network.
        check: as for `Model`, of both files.

    Raises:
        ValueError: as `Model`, or the files were not written together.
        OSError: one cannot be read.
    """

    def __init__(self, network: Path, head: Path, provider: str = CPU, check: bool = True) -> None:
        super().__init__(head, CPU, check=False)
        self.network = _session(network, provider)
        self.network_properties = _properties(network, self.network)
        for name in ("ssrvlad.fingerprint", "ssrvlad.label_space"):
            if self.network_properties[name] != self.properties[name]:
                raise ValueError(f"{network} and {head} differ in {name}: expected the two files")
        between, self.input = self.input, _input(network, self.network)
        made = [(output.name, output.type) for output in self.network.get_outputs()]
        if made != [("labels", between.type)] or between.name != "labels":
            raise ValueError(f"{network} gives {made}, {head} takes {between.name} {between.type}")
        if check:
            golden = self.golden()
            _refuse_unless_right(network if golden.difference <= TOLERANCE else head, golden)

    def golden(self) -> Golden:
        """Runs the golden pairs of both files."""
        head = _golden(self.session, "labels", self.properties)
        network = _golden(self.network, "image", self.network_properties)
        return head._replace(other_pixels=network.other_pixels) if head.holds else head

    def _run(self, given: Array) -> list[Array]:
        image = onnxruntime.OrtValue.ortvalue_from_numpy(given)
        (labels,) = self.network.run_with_ort_values(["labels"], {"image": image})
        names = ["descriptor", "unknown"]
        found = self.session.run_with_ort_values(names, {"labels": labels})
        return [each.numpy() for each in found]


def open_model(given: argparse.Namespace) -> Model:
    """The model that the command line names."""
    check = not (given.unchecked or getattr(given, "check", False))
    if given.network:
        return Split(given.network, given.model, given.provider, check)
    return Model(given.model, given.provider, check)


def add_model(parser: argparse.ArgumentParser) -> None:
    """The arguments that `open_model` reads."""
    parser.add_argument("model", type=Path, help="the .onnx file")
    parser.add_argument("--network", type=Path, help="pictures to labels, of `fuse --split`")
    parser.add_argument("--provider", default=CPU, help="of the network, or of the one file")
    parser.add_argument("--unchecked", action="store_true", help="do not run the golden pair first")


class Database:
    """Descriptors of reference frames in a `.npy` file, read as needed, and the frames' ids.

    The ids stand in ``FILE.frames.txt``, one a line, the fingerprint in ``FILE.fingerprint.txt``.

    Raises:
        ValueError: the files do not fit each other or the model.
        OSError: one cannot be read.
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        try:
            self.descriptors = _npy(path, "r")
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
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

    Raises:
        ValueError: an id has several lines.
        OSError: they cannot be written.
    """
    for frame in frames:
        _see_line(frame)
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
    model = open_model(given)
    if given.check:
        golden = model.golden()
        print(golden)
        return int(not golden.holds)
    if given.save_descriptors and model.anchors:
        raise ValueError("--save-descriptors: expected a file without --sweep, references have one")
    database = given.database and Database(given.database, model.fingerprint)
    kept: dict[str, Array] = {}
    skipped = 0
    for frame, path in find_frames(given.source):
        if frame in kept:
            raise ValueError(f"{path} is a second frame {frame}")
        if given.save_descriptors:
            _see_line(frame)
        try:
            descriptor = model.describe(path)
        except ValueError as error:
            note(f"{path}: {error}")
            skipped += 1
            continue
        kept[frame] = descriptor
        candidates = database.search(descriptor, given.top) if database else []
        report(frame, not descriptor.any(), candidates, given.json)
    if given.save_descriptors and kept:
        save(given.save_descriptors, list(kept.values()), list(kept), model.fingerprint)
    if skipped:
        note(f"skipped {skipped} of {skipped + len(kept)} frames")
    return SOME_SKIPPED if skipped else 0


def report(frame: str, empty: bool, candidates: list[tuple[str, float]], as_json: bool) -> None:
    """One line about a frame."""
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
    given = parser.parse_args()
    if bool(given.source) == given.check or given.top < 1:
        parser.error("expected frames or --check, and --top of at least 1")
    try:
        return run(given)
    except (ValueError, OSError, ImportError) as error:
        note(f"run_onnx: {one_line(error)}")
        return 2


def _session(path: Path, provider: str) -> Any:
    path.open("rb").close()
    at_hand = onnxruntime.get_available_providers()
    if provider not in at_hand:
        raise ValueError(f"no provider {provider}; expected one of {', '.join(at_hand)}")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ONLY_FATAL
    providers = [*dict.fromkeys((provider, CPU))]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # what ONNX Runtime raises has no common base
        raise ValueError(f"{path}: {one_line(error)}") from error


def _properties(path: Path, session: Any) -> dict[str, str]:
    properties = dict(session.get_modelmeta().custom_metadata_map)
    if "ssrvlad.fingerprint" not in properties or "ssrvlad.label_space" not in properties:
        raise ValueError(f"{path}: no metadata ssrvlad.*: no file of `ssrvlad export` or `fuse`")
    written = properties.get("ssrvlad.format", "1")
    if written != FORMAT:
        raise ValueError(f"{path}: a file of format {written}; expected {FORMAT}: export it again")
    return properties


def _input(path: Path, session: Any) -> Any:
    inputs = session.get_inputs()
    if len(inputs) != 1 or len(inputs[0].shape) not in (3, 4):
        names = ", ".join(f"{each.name} {each.shape}" for each in inputs)
        raise ValueError(f"{path}: expected one input of labels, scores or images, got {names}")
    return inputs[0]


def _golden(session: Any, given: str, properties: dict[str, str]) -> Golden:
    """How a file's own golden pair comes out.

    Raises:
        ValueError: it has none for its input, or cannot be run.
    """
    entries = json.loads(properties.get("ssrvlad.golden", "{}"))
    try:
        golden = {name: _array(entry) for name, entry in entries.items()}
    except (KeyError, TypeError, zlib.error) as error:
        raise ValueError(f"the golden pair is damaged: {one_line(error)}") from error
    if given not in golden:
        raise ValueError(f"no golden pair for input {given}; see `ssrvlad verify`")
    inputs = {given: golden.pop(given)}
    try:
        found = dict(zip(golden, session.run(list(golden), inputs), strict=True))
    except Exception as error:  # what ONNX Runtime raises has no common base
        raise ValueError(f"cannot run the golden pair: {one_line(error)}") from error
    if any(found[name].shape != array.shape for name, array in golden.items()):
        return Golden(float("inf"), cosine=0.0)
    other = float((found["labels"] != golden["labels"]).mean()) if "labels" in golden else 0.0
    if "descriptor" not in golden:
        return Golden(0.0, other)
    got, expected = found["descriptor"], golden["descriptor"]
    counts = golden.keys() - {"descriptor", "labels"}
    equal = all(np.array_equal(found[name], golden[name]) for name in counts)
    steps = np.nan_to_num(np.abs(got - expected), nan=np.inf)
    cosine = np.nan_to_num((got * expected).sum(-1)).min()
    return Golden(float(steps.max()) if equal else float("inf"), other, float(cosine))


def _refuse_unless_right(path: Path, golden: Golden) -> None:
    if not golden.holds:
        raise ValueError(
            f"{path} is computed wrong here ({golden}); `ssrvlad verify --provider` tells where, "
            "--unchecked runs it nevertheless"
        )
    if golden.difference > TOLERANCE:
        note(f"{path}: {golden}: the head was checked roughly; `ssrvlad verify` checks it exactly")


def _see_line(frame: str) -> None:
    """Refuses an id that cannot stand in a file of one id a line."""
    if frame.splitlines() != [frame]:
        raise ValueError(f"a database holds an id a line; frame {frame!r} has several")


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

        if image.mode in ("L", "P"):
            _see_photograph(np.asarray(image))
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def _see_photograph(values: Array) -> None:
    """Refuses what looks like a label map: small ids, and 255 for what has none, in even areas; a
    dark photograph has noise."""
    ids = np.setdiff1d(values, [255])
    is_even = np.mean(values[:, 1:] == values[:, :-1]) > _EVEN
    if len(ids) > 1 and ids[-1] <= _HIGHEST_ID and is_even:
        raise ValueError(
            f"expected a photograph, got a label map: {len(ids)} values, {ids[0]} to {ids[-1]}"
        )


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
    dtype = np.dtype(entry["dtype"])
    size = dtype.itemsize * math.prod(entry["shape"])
    if not 0 <= size <= _MOST_GOLDEN:
        raise ValueError(f"the golden pair has an array of {size} bytes; expected at most 64 MiB")
    content = zlib.decompressobj().decompress(base64.b64decode(entry["data"]), size + 1)
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype).reshape(entry["shape"])


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


if __name__ == "__main__":
    sys.exit(main())
