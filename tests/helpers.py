"""Files on disk, sequences and databases of them, records of frames that were never seen, programs
and what they refuse; shared by the tests."""

import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Collection, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from drawings import blobs
from PIL import Image
from torch import Tensor

from ssrvlad_torch import SSRVLAD, Database, SSRVLADConfig
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.results import EncodeOptions

GRAY, COLOUR, GRAY_ALPHA, COLOUR_ALPHA = 0, 2, 4, 6
"""Colour types of PNG."""


def street(seed: int, height: int = 24, width: int = 32) -> npt.NDArray[np.uint8]:
    """A small random label map in ``drawings.SPACE``."""
    return blobs(seed, height, width, 6)


PALETTES = {
    "the space's own": ([3, 8], {3: (128, 64, 128), 8: (64, 0, 128)}, [3, 8]),
    "no colour of the space": ([3, 9], {3: (1, 2, 3), 9: (4, 5, 6)}, [3, 9]),
    "own and none": ([3, 9], {3: (128, 64, 128), 9: (4, 5, 6)}, [3, 9]),
    "other ids": ([0, 1], {0: (128, 64, 128), 1: (64, 0, 128)}, [3, 8]),
    "other ids, an unused stray": (
        [0, 1],
        {0: (128, 64, 128), 1: (64, 0, 128), 2: (1, 2, 3)},
        [3, 8],
    ),
    "other ids and own": ([0, 8], {0: (128, 64, 128), 8: (64, 0, 128)}, [3, 8]),
    "other ids and a stray": ([0, 1], {0: (128, 64, 128), 1: (1, 2, 3)}, 1),
    "grays that are the ids": ([0, 3], {0: (0, 0, 0), 3: (3, 3, 3)}, [0, 3]),
    "grays that are not": ([0, 3], {0: (0, 0, 0), 3: (5, 5, 5)}, 0),
    "black: void, or id 0": ([0, 0], {0: (0, 0, 0)}, 0),
}
"""Palettes of label maps in ``camvid-11``: indices of two pixels, colours of some, and the ids,
or the index that an error names."""


def write_palette(path: Path, pixels: Sequence[int], colours: dict[int, tuple[int, ...]]) -> Path:
    """A palette image of one row."""
    image = Image.fromarray(np.array([pixels], np.uint8), "P")
    image.putpalette([part for i in range(max(colours) + 1) for part in colours.get(i, (0, 0, 0))])
    image.save(path)
    return path


def write_image(path: Path, pixels: npt.NDArray[Any]) -> Path:
    """An image of the format that its name says; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def write_street(path: Path, seed: int, height: int = 24, width: int = 32) -> Path:
    """A small random label map as an image; the folder is made."""
    return write_image(path, street(seed, height, width))


def write_pages(path: Path, form: str) -> Path:
    """A file of four small label maps."""
    first, *others = (Image.fromarray(street(seed)) for seed in range(4))
    first.save(path, form, save_all=True, append_images=others)
    return path


def write_png(path: Path, pixels: npt.NDArray[np.integer], colour_type: int, bits: int) -> Path:
    """A PNG of any colour type, ``pixels`` ``(H, W)`` or ``(H, W, C)``; Pillow cannot write all."""
    height, width = pixels.shape[:2]
    unpacked = pixels.reshape(height, -1, 1).astype(int) >> np.arange(bits - 1, -1, -1) & 1
    rows = [b"\0" + np.packbits(row).tobytes() for row in unpacked]
    packed = zlib.compress(b"".join(rows))
    path.write_bytes(png_bytes(width, height, bits, colour_type, packed))
    return path


def png_bytes(width: int, height: int, bits: int, colour_type: int, packed: bytes) -> bytes:
    """A PNG by its packed rows."""
    header = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), (b"IDAT", packed), (b"IEND", b"")):
        content += struct.pack(">I", len(data)) + kind + data
        content += struct.pack(">I", zlib.crc32(kind + data))
    return content


def tiff_bytes(
    height: int, width: int, data: bytes, bits: int = 8, channels: int = 1, packed: int = 1,
    order: str = "<",
) -> bytes:  # fmt: skip
    """A TIFF of one strip in a byte order, ``packed`` 1 for no compression or 8 for zlib's; Pillow
    cannot write all."""
    tags = {
        256: width, 257: height, 258: bits, 259: packed, 262: 2 if channels == 3 else 1, 273: 8,
        277: channels, 278: height, 279: len(data), 284: 1,
    }  # fmt: skip
    directory = struct.pack(f"{order}H", len(tags))
    for tag, value in tags.items():
        directory += struct.pack(f"{order}HHII", tag, 4, 1, value)
    head = b"II*\0" if order == "<" else b"MM\0*"
    return head + struct.pack(f"{order}I", 8 + len(data)) + data + directory + bytes(4)


def flip_byte(path: Path, position: int, bits: int = 0x55) -> None:
    """Damages one byte of a file."""
    content = bytearray(path.read_bytes())
    content[position] ^= bits
    path.write_bytes(content)


def spoil(database: Path, descriptor: Tensor) -> Path:
    """Changes one bit of a stored descriptor; its file."""
    for file in (database / "data").glob("*.lance"):
        place = file.read_bytes().find(descriptor.numpy().tobytes())
        if place >= 0:
            flip_byte(file, place + 8, 1)
            return file
    raise AssertionError(f"{database} does not hold this descriptor")


def record(frame: str, **fields: object) -> FrameRecord:
    """The record of a frame by its id."""
    plain = {"height": 24, "width": 32, "digest": f"digest of {frame}"}
    return FrameRecord.of_id(frame)._replace(**{**plain, **fields})


def descriptors(seed: int, count: int, length: int = 480) -> Tensor:
    """``(count, length)`` float32 of length 1."""
    numbers = torch.randn(count, length, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(numbers, dim=1)


def grids(count: int, shape: Sequence[int], seed: int = 0) -> Tensor:
    """``(count, *shape)`` random signs, eight in a byte."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.integers(0, 256, (count, *shape), np.uint8))


def without(blocked: Sequence[str], script: Path, *arguments: object) -> list[str]:
    """The command that runs a script in a process which cannot import some packages."""
    code = (
        "import runpy, sys\n"
        f"sys.modules |= dict.fromkeys({list(blocked)!r})\n"
        f"sys.path.insert(0, {str(script.parent)!r})\n"
        f"sys.argv = {[str(script), *map(str, arguments)]!r}\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')\n"
        f"assert not {{*{list(blocked)!r}}} & {{n for n, m in sys.modules.items() if m}}\n"
    )
    return [sys.executable, "-c", code]


def outcome(*command: object, **options: Any) -> tuple[int, list[str], list[str]]:
    """The exit code of a program, and the lines that it prints on stdout and on stderr; options
    are those of `subprocess.run`."""
    words = [*map(str, command)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    return done.returncode, done.stdout.splitlines(), done.stderr.splitlines()


def assert_no_reader_is_no_error(*command: object) -> None:
    """What ``... | head -1`` does, with a pipe that nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*map(str, command)], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def assert_each_is_one_line(program: Any, table: Sequence[tuple[Any, str]], silent=True) -> None:
    """Asserts that a program refuses each arguments of a table in one line that has a text, and
    prints no result before."""
    for arguments, message in table:
        code, out, errors = program(*arguments)
        assert (code, len(errors)) == (2, 1), (arguments, errors)
        assert message in errors[0] and not (silent and out)


@contextmanager
def refused(message, *names, by=ValueError):
    """Expects an error whose message is one line, matches, and holds these names."""
    with pytest.raises(by, match=message) as refusal:
        yield refusal
    text = str(refusal.value)
    assert text and "\n" not in text
    assert all(str(name) in text for name in names), text


def refuses(message, call, *arguments, **options):
    """Asserts that a call is refused by a ValueError; see `refused`."""
    with refused(message):
        call(*arguments, **options)


def touch(*paths):
    """Empty files: finding does not look into images."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


CONFIG = SSRVLADConfig.from_preset("default", labels_as="camvid-11")
FRAMES = ["day/10", "day/2", "night/1", "day/9"]
SORTED = ("day/2", "day/9", "day/10", "night/1")
"""The frames of `filled`, as they were added and in natural order."""


def fill(into, frames, seed=0):
    into.append([record(frame) for frame in frames], descriptors(seed, len(frames)))


def loaded(path, **which):
    frames = Database.open(path, **which).load()
    return dict(zip(frames.frames, frames.descriptors.tolist(), strict=True))


def filled(folder):
    """The path of a database with `FRAMES`."""
    fill(Database.create(folder / "town.ssrdb", CONFIG), FRAMES)
    return folder / "town.ssrdb"


def write_maps(folder: Path, seeds: range) -> Path:
    """A sequence of small label maps in ``drawings.SPACE``."""
    for seed in seeds:
        write_street(folder / f"{seed:03d}.png", seed)
    return folder


def write_map(ssrvlad, path, *sources, segmenter=None):
    """A database of label maps of cities, or of what a network sees in pictures; also in NumPy's
    form as ``path``."""
    database = path.with_suffix(".ssrdb")
    kind = ("--segmenter", segmenter) if segmenter else ("--labels-as", "camvid-11")
    assert ssrvlad("encode", *sources, "-o", database, *kind)[0] == 0
    assert ssrvlad("db", "export", database, "--format", "npy", "-o", path)[0] == 0
    return database


def write_photos(folder: Path, seeds: range, suffix: str = ".png") -> Path:
    """A sequence of images without meaning, each its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        gray = np.random.default_rng(seed).integers(0, 256, (12, 16), dtype=np.uint8)
        picture = Image.fromarray(gray).resize((128, 96)).convert("RGB")
        picture.save(folder / f"{seed:03d}{suffix}")
    return folder


def write_two_drives(folder: Path, count: int) -> Path:
    """Drives ``query`` and ``reference`` past the same places, with images and label maps."""
    for drive in ("query", "reference"):
        write_photos(folder / drive / "images", range(count), ".jpg")
        write_maps(folder / drive / "labels", range(count))
    return folder


def write_truth(path: Path, content: object) -> Path:
    """A ground truth in the form that the file's name says."""
    if path.suffix == ".npy":
        np.save(path, content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")


class Maps:
    def __init__(self, folder):
        self.folder = folder

    def add(self, sequence, numbers, height=24, width=32):
        for number in numbers:
            write_street(self.folder / sequence / f"{number}.png", number, height, width)

    def files(self, *folders, **options):
        folders = [str(self.folder / folder) for folder in folders or ("[ab]",)]
        return find_label_files(folders, **options)

    def database(self):
        return Database.open_or_create(self.folder / "town.ssrdb", HEAD.config)

    def encode(self, *folders, head=HEAD, sequence=None, map_folders=(), **options):
        files = self.files(*folders, sequence=sequence, map_folders=map_folders)
        return encode_to_database(head, files, self.database(), EncodeOptions(**options))


def alone(labels):
    return HEAD(torch.from_numpy(labels)[None])[0]


def assert_streets(frames, seeds):
    """Asserts that frames have the descriptors of these streets."""
    assert torch.equal(frames.descriptors, torch.stack([alone(street(seed)) for seed in seeds]))


def counts(summary):
    return summary.encoded, summary.already_there, len(summary.skipped)


def rewrite(path, seed):
    """Replaces a label map by another, in a new file."""
    path.unlink()
    write_street(path, seed)


PACKAGE = Path(__file__).parents[1] / "ssrvlad_torch"


class Lines:
    """Runs a call, and interrupts it at a line of some files of the package.

    Args:
        files: below the package, or folders.
        at: number of the line at which a KeyboardInterrupt is raised, of those that are reached for
            the first time; without, none is raised.

    Attributes:
        count: of the lines that were reached.
    """

    def __init__(self, files: Collection[str], at: int | None = None) -> None:
        self._files, self._at = tuple(str(PACKAGE / file) for file in files), at
        self._lines = set[tuple[str, int]]()

    @property
    def count(self) -> int:
        return len(self._lines)

    def _enter(self, frame: Any, event: str, _: object) -> Any:
        return self._line if frame.f_code.co_filename.startswith(self._files) else None

    def _line(self, frame: Any, event: str, _: object) -> Any:
        line = frame.f_code.co_filename, frame.f_lineno
        if event == "line" and line not in self._lines:
            self._lines.add(line)
            if self.count == self._at:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._line

    def run(self, call: Callable[[], object]) -> bool:
        """Runs a call; whether it was interrupted."""
        before = sys.gettrace()
        sys.settrace(self._enter)
        try:
            call()
        except KeyboardInterrupt:
            return True
        finally:
            sys.settrace(before)
        return False
