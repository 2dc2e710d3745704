"""What a label map on disk holds, in each format."""

import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers import (
    COLOUR,
    COLOUR_ALPHA,
    GRAY,
    GRAY_ALPHA,
    PALETTES,
    refuses,
    street,
    tiff_bytes,
    write_pages,
    write_palette,
    write_png,
)
from PIL import Image

from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.label_files import digest, find_label_files, read_label_map
from ssrvlad_torch.encoding.selection import FrameSelection
from ssrvlad_torch.encoding.source import open_frames
from ssrvlad_torch.taxonomy import colourise, label_space, palette

CAMVID = label_space("camvid-11")
LABELS = street(0)
SUFFIXES = (".png", ".PNG", ".tif", ".tiff", ".bmp")


def read(path, space=CAMVID, row=None):
    return read_label_map(FrameFile("sequence", "name", path, row), space)


def beside(first, *channels):
    """``(H, W, C)`` uint16: a label map and other channels full of large random numbers."""
    noise = np.random.default_rng(1).integers(0, 1 << 16, (*first.shape, len(channels)))
    return np.concatenate((first[..., None].astype(np.uint16), noise.astype(np.uint16)), axis=2)


def array(content):
    def write(path):
        with path.open("wb") as file:
            np.save(file, content)

    return write


def image(pixels, form=None, **options):
    return lambda path: Image.fromarray(pixels).save(path, format=form, **options)


def content(text):
    return lambda path: path.write_text(text)


def swapped(path):
    """With the high byte first."""
    data = WIDE.astype(">u2").tobytes()
    Image.frombytes("I;16B", WIDE.shape[::-1], data).save(path)


def with_palette(labels, colours, **options):
    def write(path):
        picture = Image.fromarray(labels)
        picture.putpalette(colours)
        assert picture.mode == "P"
        picture.save(path, **options)
        assert "bits" not in options or path.read_bytes()[24] == options["bits"]

    return write


def png(pixels, colour_type, bits):
    return lambda path: write_png(path, pixels, colour_type, bits)


def wide_tiff(pixels, order):
    data = pixels.astype(f"{order}u2").tobytes()
    content = tiff_bytes(*pixels.shape[:2], data, bits=16, channels=3, order=order)
    return lambda path: path.write_bytes(content)


RANDOM = np.random.default_rng(0).integers(0, 256, 768).tolist()
WIDE = LABELS.astype(np.uint16) + 1000
LARGE = np.random.default_rng(2).integers(0, 65536, (24, 32)).astype(np.uint16)
SMALL = LARGE % np.uint16(12)
WIDE_GRAYS = np.dstack([LABELS.astype(np.uint16)] * 3)
STORED = [
    *((f"gray{end}", image(LABELS), LABELS) for end in SUFFIXES),
    *((f"palette{end}", with_palette(LABELS, RANDOM), LABELS) for end in SUFFIXES),
    *(
        (f"{n} bits.png", with_palette(LABELS % 2**n, RANDOM[: 3 * 2**n], bits=n), LABELS % 2**n)
        for n in (1, 2, 4)
    ),
    ("wide.png", image(WIDE), WIDE),
    ("wide.tif", image(WIDE), WIDE),
    ("wider.tif", image(LABELS.astype(np.int32) + 10**5), LABELS.astype(np.int32) + 10**5),
    ("swapped.tif", swapped, WIDE),
    ("swapped.npy", array(WIDE.astype(">i4")), WIDE.astype(np.int32)),
    *(  # SYNTHIA: the class in the first channel, the instance in the second
        (f"{others} of {labels.max()}.png", png(beside(labels, *others), kind, 16), labels)
        for kind, others in ((GRAY_ALPHA, "i"), (COLOUR, "gb"), (COLOUR_ALPHA, "gba"))
        for labels in (SMALL, LARGE)
    ),
    ("equal.png", image(np.dstack([LABELS] * 3)), LABELS),
    ("equal.bmp", lambda p: cv2.imwrite(str(p), np.dstack([LABELS] * 3)), LABELS),
    ("CARLA.png", image(np.dstack([LABELS, 0 * LABELS, 0 * LABELS, 255 + 0 * LABELS])), LABELS),
    ("alpha.png", png(np.dstack([LABELS, LABELS * 20]), GRAY_ALPHA, 8), LABELS),
    ("opencv.png", lambda p: cv2.imwrite(str(p), beside(SMALL, *"gb")[..., ::-1]), SMALL),
    *(
        (f"{dtype}{end}", array(np.asfortranarray(LABELS.astype(dtype))), LABELS.astype(read))
        for dtype, read in zip(
            ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8"),
            ("u1", "i1", "u2", "i2", "i8", "i4", "i8", "i8"),
            strict=True,
        )
        for end in (".npy", ".NPY")
    ),
]


@pytest.mark.parametrize(("name", "write", "labels"), STORED, ids=[name for name, *_ in STORED])
def test_ids_are_read_as_they_are_stored(tmp_path, name, write, labels):
    """In the machine's byte order: torch takes no other."""
    write(tmp_path / name)
    ids = read(tmp_path / name)
    assert ids.dtype == labels.dtype and ids.dtype.isnative
    np.testing.assert_array_equal(ids, labels)


def test_a_palette_of_the_label_space_s_colours_says_the_ids(tmp_path):
    space = label_space("cityscapes-trainids")
    labels = LABELS % 19
    labels[0, :3] = 255
    image(colourise(labels, space))(tmp_path / "colours.png")
    # as a PNG optimiser does: a palette of the colours that occur, in an order of its own
    used, indices = np.unique(labels, return_inverse=True)
    order = np.random.default_rng(4).permutation(len(used))
    reordered = order[indices].reshape(labels.shape).astype(np.uint8)
    shown = palette(space)[used[np.argsort(order)]].tobytes()
    with_palette(reordered, shown)(tmp_path / "optimised.png")
    with_palette(labels, palette(space).tobytes())(tmp_path / "palette.png")
    files = find_label_files([str(tmp_path)])
    colours, optimised, plain = (read_label_map(file, space) for file in files)
    np.testing.assert_array_equal(optimised, colours)
    np.testing.assert_array_equal(plain, labels)


@pytest.mark.parametrize(("pixels", "colours", "ids"), PALETTES.values(), ids=PALETTES)
def test_palette_colours_that_pixels_show_decide_between_indices_and_colours(
    tmp_path, pixels, colours, ids
):
    path = write_palette(tmp_path / "a.png", pixels, colours)
    if isinstance(ids, list):
        assert read(path).tolist() == [ids]
    else:
        refuses(rf"the palette shows index {ids} as .*; expected", read, path)


def test_the_index_or_the_red_channel_is_the_id_if_the_user_says_so(tmp_path):
    gray = np.repeat(np.arange(256), 3)[::-1].tolist()
    with_palette(LABELS, gray)(tmp_path / "palette.png")
    image(np.dstack([LABELS, LABELS * 3, LABELS + 7]))(tmp_path / "instances.png")
    for file in find_label_files([str(tmp_path)]):
        refuses(".", read_label_map, file, CAMVID)
        np.testing.assert_array_equal(
            read_label_map(replace(file, index_is_id=True), CAMVID), LABELS
        )
    selection = FrameSelection([str(tmp_path)], labels_as="camvid-11", index_is_id=True)
    assert all(file.index_is_id for file in open_frames(selection).files)


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("space", ["camvid-32", "camvid-11"])
def test_colours_become_ids(tmp_path, space, alpha):
    ids = np.array([label.id for label in label_space(space).classes])
    labels = ids[np.random.default_rng(3).integers(0, len(ids), (24, 32))]
    assert set(labels.flat) == set(ids)
    picture = colourise(labels, space)
    if alpha:
        picture = np.dstack([picture, np.full(labels.shape, 17, np.uint8)])
    Image.fromarray(picture).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read(tmp_path / "a.png", label_space(space)), labels)


def test_an_unknown_colour_is_named_with_its_pixels(tmp_path):
    picture = colourise(LABELS, "camvid-11")
    picture[3:5, 7:10] = (1, 2, 3)
    Image.fromarray(picture).save(tmp_path / "a.png")
    refuses(r"colour \(1, 2, 3\) \(6 pixels\) .*camvid-11.* photo", read, tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".npy", ".NPY"])
def test_a_stack_holds_a_label_map_a_row(tmp_path, suffix):
    stack = np.stack([street(seed) for seed in range(3)])
    path = tmp_path / f"stack{suffix}"
    with path.open("wb") as file:
        np.save(file, stack)
    files = find_label_files([str(path)])
    assert [file.frame for file in files] == [f"stack/stack-00000{n}" for n in range(3)]
    for file, labels in zip(files, stack, strict=True):
        np.testing.assert_array_equal(read_label_map(file, CAMVID), labels)
    np.save(tmp_path / "shorter.npy", LABELS[None])
    refuses("index 1 is out of bounds", read, tmp_path / "shorter.npy", row=1)


ONE_HOT = np.eye(19, dtype=np.uint8)[LABELS]


@pytest.mark.parametrize(
    "array",
    [
        np.dstack([LABELS] * 3),
        np.dstack([LABELS, 0 * LABELS, 0 * LABELS, 0 * LABELS + 255]),
        ONE_HOT,
        ONE_HOT.transpose(2, 0, 1) * 255,
        np.where(LABELS[..., None] == 3, 0, ONE_HOT),
        ONE_HOT.astype(np.float32),
        LABELS[:, None],
    ],
    ids=["gray", "CARLA", "one-hot", "masks", "with void", "scores", "lines"],
)
def test_an_array_that_could_be_one_map_or_a_stack_is_one_frame_and_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    [file] = find_label_files([tmp_path / "a.npy"])
    refuses(rf"or a stack \(N, H, W\) of them, got \({len(array)}, ", read_label_map, file, CAMVID)


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("missing.png", lambda path: None, "No such file"),
        ("zero.png", content(""), "cannot identify"),
        ("text.png", content("hello"), "cannot identify"),
        ("photo.png", image(LABELS, "JPEG"), "cannot identify"),
        ("float.npy", array(LABELS / 2), r"integer label map .*, got \(24, 32\) float64"),
        ("bool.npy", array(LABELS > 3), "integer label map .*, got .* bool"),
        ("float.png", image(LABELS / 2, "TIFF"), "mode F"),
        ("four.npy", array(np.zeros((2, 3, 4, 5), int)), r"got \(2, 3, 4, 5\)"),
        ("pickle.npy", lambda path: np.save(path, np.array([[{"id": 3}]])), "holds Python objects"),
        # id 3 of two bits would be read as 255, which is void in many label spaces
        *((f"{n} bits.png", png(LABELS % 2**n, GRAY, n), "scaled|mode 1") for n in (1, 2, 4)),
        # Pillow keeps the high bytes of colours only, and all of these would be (0, 0, 0)
        *((f"{order}.tif", wide_tiff(WIDE_GRAYS, order), "would be read scaled") for order in "<>"),
        ("pages.tif", lambda p: write_pages(p, "TIFF"), "has 4 pages; expected one"),
        (os.fsdecode(b"\xff.png"), image(LABELS, "PNG"), "surrogates not allowed"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path, name, write, message):
    """The last has a name that a database could not hold."""
    path = tmp_path / name
    write(path)
    refuses(message, read_label_map, FrameFile("sequence", path.stem, path), CAMVID)


def test_the_digest_is_of_the_ids_and_the_shape_and_not_of_the_format():
    assert digest(LABELS) == digest(np.asfortranarray(LABELS.astype(np.int64)))
    assert digest(LABELS) == digest(LABELS.astype(">u2"))
    assert len(digest(LABELS)) == 32
    other = LABELS.copy()
    other[5, 5] += 1
    turned = LABELS.reshape(32, 24)
    different = [LABELS, other, turned, LABELS + np.uint16(256), -LABELS.astype(int)]
    assert len({digest(labels) for labels in different}) == len(different)
