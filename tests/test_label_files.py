"""What a label map on disk holds, in each format."""

import os
import struct

import cv2
import numpy as np
import pytest
from helpers import (
    COLOUR,
    COLOUR_ALPHA,
    GRAY,
    GRAY_ALPHA,
    PALETTES,
    flip_byte,
    refused,
    street,
    write_palette,
    write_png,
)
from PIL import Image

from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.label_files import digest, find_label_files, read_label_map
from ssrvlad_torch.taxonomy import colourise, label_space, palette

CAMVID = label_space("camvid-11")
LABELS = street(0)


def read(path, space=CAMVID, row=None):
    return read_label_map(FrameFile("sequence", "name", path, row), space)


def raw_tiff(pixels, order):
    """A TIFF of ``(H, W, 3)`` 16-bit colours in a byte order; Pillow cannot write it."""
    height, width, _ = pixels.shape
    data = pixels.astype(f"{order}u2").tobytes()
    tags = {
        256: width, 257: height, 258: 16, 259: 1, 262: 2, 273: 8,
        277: 3, 278: height, 279: len(data), 284: 1,
    }  # fmt: skip
    directory = struct.pack(f"{order}H", len(tags))
    for tag, value in tags.items():
        directory += struct.pack(f"{order}HHII", tag, 4, 1, value)
    head = b"II*\0" if order == "<" else b"MM\0*"
    return head + struct.pack(f"{order}I", 8 + len(data)) + data + directory + bytes(4)


def beside(first, *channels):
    """``(H, W, C)`` uint16: a label map and other channels full of large random numbers."""
    noise = np.random.default_rng(1).integers(0, 1 << 16, (*first.shape, len(channels)))
    return np.concatenate((first[..., None].astype(np.uint16), noise.astype(np.uint16)), axis=2)


@pytest.mark.parametrize("suffix", [".png", ".PNG", ".tif", ".tiff", ".bmp"])
@pytest.mark.parametrize("as_palette", [False, True])
def test_eight_bit_gray_and_palette_images_hold_ids(tmp_path, suffix, as_palette):
    image = Image.fromarray(LABELS)
    if as_palette:
        image.putpalette(np.random.default_rng(0).integers(0, 256, 768).astype(np.uint8).tobytes())
        assert image.mode == "P"
    image.save(tmp_path / f"a{suffix}", format={".PNG": "PNG"}.get(suffix))
    labels = read(tmp_path / f"a{suffix}")
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, LABELS)


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_palette_images_of_few_bits_hold_ids(tmp_path, bits):
    labels = LABELS % (1 << bits)
    image = Image.fromarray(labels)
    image.putpalette([value for value in range(1 << bits) for _ in range(3)])
    image.save(tmp_path / "a.png", bits=bits)
    assert (tmp_path / "a.png").read_bytes()[24] == bits
    np.testing.assert_array_equal(read(tmp_path / "a.png"), labels)


def save_renumbered(path, labels, colours):
    """As a PNG optimiser does: a palette of the colours that occur, in an order of its own."""
    used, indices = np.unique(labels, return_inverse=True)
    order = np.random.default_rng(4).permutation(len(used))
    image = Image.fromarray(order[indices].reshape(labels.shape).astype(np.uint8), "P")
    image.putpalette(colours[used[np.argsort(order)]].tobytes())
    image.save(path)


def test_a_palette_of_the_label_space_s_colours_says_the_ids(tmp_path):
    space = label_space("cityscapes-trainids")
    labels = LABELS % 19
    labels[0, :3] = 255
    save_renumbered(tmp_path / "optimised.png", labels, palette(space))
    Image.fromarray(colourise(labels, space)).save(tmp_path / "colours.png")
    image = Image.fromarray(labels)
    image.putpalette(palette(space).tobytes())
    image.save(tmp_path / "palette.png")
    files = find_label_files([str(tmp_path)])
    colours, optimised, plain = (read_label_map(file, space) for file in files)
    np.testing.assert_array_equal(optimised, colours)
    np.testing.assert_array_equal(plain, labels)


@pytest.mark.parametrize(("pixels", "colours", "ids"), PALETTES.values(), ids=PALETTES)
def test_what_pixels_show_of_a_palette_decides(tmp_path, pixels, colours, ids):
    path = write_palette(tmp_path / "a.png", pixels, colours)
    if isinstance(ids, list):
        assert read(path).tolist() == [ids]
    else:
        with pytest.raises(ValueError, match=rf"the palette shows index {ids} as .*; expected"):
            read(path)


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_gray_of_few_bits_is_refused_rather_than_scaled(tmp_path, bits):
    """Id 3 of two bits would be read as 255, which is void in many label spaces."""
    path = write_png(tmp_path / "a.png", LABELS % (1 << bits), GRAY, bits)
    with pytest.raises(ValueError, match=r"scaled|image of mode 1"):
        read(path)


@pytest.mark.parametrize(
    ("name", "dtype"), [("a.png", np.uint16), ("a.tif", np.uint16), ("a.tif", np.int32)]
)
def test_gray_of_many_bits_holds_ids(tmp_path, name, dtype):
    labels = LABELS.astype(dtype) + (1000 if dtype == np.uint16 else 100_000)
    Image.fromarray(labels).save(tmp_path / name)
    found = read(tmp_path / name)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, labels)


def test_the_other_byte_order_is_turned(tmp_path):
    """Torch takes only the machine's own."""
    labels = LABELS.astype(np.uint16) + 1000
    image = Image.frombytes("I;16B", labels.shape[::-1], labels.astype(">u2").tobytes())
    image.save(tmp_path / "a.tif")
    np.save(tmp_path / "a.npy", labels.astype(">i4"))
    for name in ("a.tif", "a.npy"):
        found = read(tmp_path / name)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, labels)


@pytest.mark.parametrize(
    ("colour_type", "others"), [(GRAY_ALPHA, "i"), (COLOUR, "gb"), (COLOUR_ALPHA, "gba")]
)
@pytest.mark.parametrize("largest", [11, 65535])
def test_sixteen_bit_channels_hold_the_class_first(tmp_path, colour_type, others, largest):
    """SYNTHIA: the class in the first channel, the instance in the second."""
    labels = np.random.default_rng(2).integers(0, largest + 1, (24, 32)).astype(np.uint16)
    path = write_png(tmp_path / "a.png", beside(labels, *others), colour_type, 16)
    np.testing.assert_array_equal(read(path), labels)


def test_channels_of_opencv_and_of_eight_bits_hold_the_class_first(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), beside(LABELS, *"gb")[..., ::-1])
    np.testing.assert_array_equal(read(tmp_path / "a.png"), LABELS)
    path = write_png(tmp_path / "a.png", np.dstack([LABELS, LABELS * 20]), GRAY_ALPHA, 8)
    np.testing.assert_array_equal(read(path), LABELS)


@pytest.mark.parametrize("order", ["<", ">", "compressed"])
def test_sixteen_bit_colour_outside_png_is_refused_rather_than_read_as_void(tmp_path, order):
    """Pillow keeps the high bytes only, and all of these are (0, 0, 0)."""
    pixels = np.dstack([LABELS.astype(np.uint16)] * 3)
    if order == "compressed":
        cv2.imwrite(str(tmp_path / "a.tif"), pixels)
    else:
        (tmp_path / "a.tif").write_bytes(raw_tiff(pixels, order))
    with pytest.raises(ValueError, match="would be read scaled; expected"):
        read(tmp_path / "a.tif")


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("space", ["camvid-32", "camvid-11"])
def test_colours_become_ids(tmp_path, space, alpha):
    known = np.array([label.id for label in label_space(space).classes])
    labels = known[np.random.default_rng(3).integers(0, len(known), (24, 32))]
    assert set(labels.flat) == set(known)
    picture = colourise(labels, space)
    if alpha:
        picture = np.dstack([picture, np.full(labels.shape, 17, np.uint8)])
    Image.fromarray(picture).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read(tmp_path / "a.png", label_space(space)), labels)


def test_classes_that_share_a_colour_keep_their_category(tmp_path):
    space = label_space("cityscapes-ids")
    labels = np.array([[label.id for label in space.classes]])
    Image.fromarray(colourise(labels, space.name)).save(tmp_path / "a.png")
    category = {label.id: label.category for label in space.classes}
    found = read(tmp_path / "a.png", space)
    assert [category[i] for i in found.flat] == [category[i] for i in labels.flat]


def test_an_unknown_colour_is_named_with_its_pixels(tmp_path):
    picture = colourise(LABELS, "camvid-11")
    picture[3:5, 7:10] = (1, 2, 3)
    Image.fromarray(picture).save(tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"colour \(1, 2, 3\) \(6 pixels\) .*camvid-11.* photo"):
        read(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".npy", ".NPY"])
@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8"])
def test_arrays_hold_ids(tmp_path, suffix, dtype):
    with (tmp_path / f"a{suffix}").open("wb") as file:
        np.save(file, np.asfortranarray(LABELS.astype(dtype)))
    found = read(tmp_path / f"a{suffix}")
    assert found.dtype in (np.uint8, np.int8, np.uint16, np.int16, np.int32, np.int64)
    np.testing.assert_array_equal(found, LABELS)


@pytest.mark.parametrize("dtype", ["u4", "u8"])
def test_the_largest_unsigned_id_does_not_become_minus_one(tmp_path, dtype):
    """-1 is a licence plate in Cityscapes."""
    np.save(tmp_path / "a.npy", np.full((2, 2), np.iinfo(dtype).max, dtype))
    assert (read(tmp_path / "a.npy") >= (1 << 32) - 1).all()


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
    with pytest.raises(ValueError, match="index 1 is out of bounds"):
        read(tmp_path / "shorter.npy", row=1)


def array(content):
    return lambda path: np.save(path, content, allow_pickle=True)


def image(pixels, form="PNG"):
    return lambda path: Image.fromarray(pixels).save(path, format=form)


def content(text):
    return lambda path: path.write_text(text)


def zipped(path):
    with path.open("wb") as file:
        np.savez(file, LABELS)


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("missing.png", lambda path: None, "No such file"),
        ("missing.npy", lambda path: None, "No such file"),
        ("zero.png", content(""), "cannot identify"),
        ("zero.npy", content(""), "."),
        ("text.png", content("hello"), "cannot identify"),
        ("text.npy", content("hello"), "magic string"),
        ("photo.png", image(LABELS, "JPEG"), "cannot identify"),
        ("zip.npy", zipped, "magic string"),
        ("float.npy", array(LABELS / 2), r"integer label map, got \(24, 32\) float64"),
        ("bool.npy", array(LABELS > 3), "integer label map, got .* bool"),
        ("float.png", image(LABELS / 2, "TIFF"), "mode F"),
        ("four.npy", array(np.zeros((2, 3, 4, 5), int)), r"got \(2, 3, 4, 5\)"),
        ("one.npy", array(np.zeros(5, int)), r"got \(5,\)"),
        ("nothing.npy", array(np.zeros((0, 5), int)), r"got \(0, 5\)"),
        ("pickle.npy", array(np.array([[{"id": 3}]])), "holds Python objects"),
        ("bilevel.png", image(LABELS > 3), "mode 1"),
        (os.fsdecode(b"\xff.png"), image(LABELS), "surrogates not allowed"),
    ],
)
def test_what_is_no_label_map_is_refused_in_one_line(tmp_path, name, write, message):
    """The last has a name that a database could not hold."""
    path = tmp_path / name
    write(path)
    with refused(message):
        read_label_map(FrameFile("sequence", path.stem, path), CAMVID)


def test_a_png_is_refused_wherever_it_is_cut_or_damaged(tmp_path):
    """Pillow decodes many of these without a word; the checksums of PNG tell."""
    path = tmp_path / "a.png"
    Image.fromarray(LABELS).save(path)
    whole = path.read_bytes()
    end = whole.index(b"IEND") - 4
    for length in range(0, end, 7):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"."):
            read(path)
    for position in range(end):
        path.write_bytes(whole)
        flip_byte(path, position)
        with pytest.raises(ValueError, match=r"."):
            read(path)


def test_the_digest_is_of_the_ids_and_the_shape_and_not_of_the_format():
    assert digest(LABELS) == digest(np.asfortranarray(LABELS.astype(np.int64)))
    assert digest(LABELS) == digest(LABELS.astype(">u2"))
    assert len(digest(LABELS)) == 32
    other = LABELS.copy()
    other[5, 5] += 1
    turned = LABELS.reshape(32, 24)
    different = [LABELS, other, turned, LABELS + np.uint16(256), -LABELS.astype(int)]
    assert len({digest(labels) for labels in different}) == len(different)
