"""Images on disk: found as label maps are, and decoded as they are seen."""

import io
import struct
from zlib import crc32

import numpy as np
import pytest
from helpers import COLOUR, flip_byte, refused, refuses, tiff_bytes, write_pages, write_png
from PIL import Image

from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.image_files import decode_image, pixels_of, read_image
from ssrvlad_torch.files import npy_bytes

PICTURE = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
SMOOTH = np.linspace((0, 40, 250), (250, 90, 0), 20 * 30).reshape(20, 30, 3).astype(np.uint8)


def encoded(pixels, form, **options):
    content = io.BytesIO()
    is_array = isinstance(pixels, np.ndarray)
    image = Image.fromarray(np.ascontiguousarray(pixels)) if is_array else pixels
    image.save(content, form, **options)
    return content.getvalue()


def turned(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return {"exif": exif}


def read(path, row=None):
    return read_image(FrameFile("sequence", "name", path, row))


# ---- what a file holds


RNG = np.random.default_rng(1)
ALPHA, IDS = RNG.integers(0, 256, (20, 30), np.uint8), RNG.integers(0, 200, (20, 30), np.uint8)
COLOURS = RNG.integers(0, 256, (256, 3), np.uint8)
SHADES, GRAYS = SMOOTH[..., 0], np.repeat(SMOOTH[..., :1], 3, axis=2)
WIDE = SHADES.astype(np.uint16) << 8 | ALPHA
"""Gray of 16 bits, of which Pillow's own conversion would clip nearly all to white."""
OTHER_ARRAYS = PICTURE / 255, PICTURE[..., :2], PICTURE[..., 0], PICTURE[:0], np.uint16(PICTURE)
PALETTED = Image.fromarray(IDS)
PALETTED.putpalette(COLOURS.tobytes())
STORED = {
    **{form: (encoded(PICTURE, form), PICTURE) for form in ("PNG", "BMP", "TIFF", "PPM")},
    "WEBP": (encoded(PICTURE, "WEBP", lossless=True), PICTURE),
    **{f"gray {form}": (encoded(SHADES, form), GRAYS) for form in ("PNG", "TIFF", "BMP")},
    **{f"wide {form}": (encoded(WIDE, form), GRAYS) for form in ("PNG", "TIFF")},
    **{
        f"turned {form}": (encoded(np.rot90(WIDE), form, **turned(6)), GRAYS)
        for form in ("PNG", "TIFF")
    },
    "alpha": (encoded(np.dstack([PICTURE, ALPHA]), "PNG"), PICTURE),
    "gray and alpha": (encoded(np.dstack([SHADES, ALPHA]), "PNG"), GRAYS),
    "palette": (encoded(PALETTED, "PNG"), COLOURS[IDS]),
    # Pillow warns of the plain conversion of transparent entries; a warning fails here
    "transparent": (encoded(PALETTED, "PNG", transparency=3), COLOURS[IDS]),
    "translucent": (encoded(PALETTED, "PNG", transparency=bytes(range(200))), COLOURS[IDS]),
}


@pytest.mark.parametrize(("content", "pixels"), STORED.values(), ids=STORED)
def test_what_is_stored_without_loss_is_read_without_loss(content, pixels):
    """Gray has three equal channels, alpha is dropped, 16 bits keep their high byte."""
    np.testing.assert_array_equal(decode_image(content), pixels)


def test_a_jpeg_is_read_whatever_its_name_colours_and_order(tmp_path):
    """The content says the format and not the name. Adobe stores CMYK inverted; read plainly it
    would be a negative."""
    cmyk = Image.fromarray(SMOOTH).convert("CMYK")
    contents = [encoded(cmyk, "JPEG", quality=95)]
    assert Image.open(io.BytesIO(contents[0])).mode == "CMYK"
    contents += [encoded(SMOOTH, "JPEG", quality=95, progressive=flag) for flag in (False, True)]
    for content in contents:
        (tmp_path / "a.png").write_bytes(content)
        for pixels in (decode_image(content), read(tmp_path / "a.png")):
            assert pixels.dtype == np.uint8
            assert np.abs(pixels.astype(int) - SMOOTH).max() < 12
    gray = decode_image(encoded(SHADES, "JPEG"))
    assert (gray[..., :1] == gray).all() and np.abs(gray.astype(int) - GRAYS).max() < 5


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_an_image_is_turned_upright(orientation, form):
    """The eight orientations of EXIF 2.3, written out: what the camera stored for SMOOTH."""
    upright = SMOOTH
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    quality = {"quality": 95} if form in ("JPEG", "WEBP") else {}
    image = decode_image(encoded(stored, form, **turned(orientation), **quality))
    assert image.shape == upright.shape
    assert np.abs(image.astype(int) - upright).max() < 24


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is no image file; expected JPEG, PNG, WEBP, BMP, TIFF, PPM or .npy"),
        (b"hello", "is no image file"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n", "is no image file"),
        (encoded(SMOOTH[..., 0].astype(np.float32), "TIFF"), "8 or 16 bits .* got mode F"),
        (encoded(SMOOTH[..., 0].astype(np.int32), "TIFF"), "8 or 16 bits .* got mode I"),
        (encoded(PICTURE, "GIF"), "is no image file"),
        *((npy_bytes(array), r"an \(H, W, 3\) uint8 image .*, got") for array in OTHER_ARRAYS),
    ],
)
def test_other_files_are_refused_in_one_line(content, message):
    with refused(message) as refusal:
        decode_image(content)
    assert "0x" not in str(refusal.value)


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM"])
def test_a_damaged_image_is_refused(form, tmp_path):
    """Wherever it is cut; a PNG also if a byte is flipped. Pillow decodes many of these without a
    word; the checksums of PNG tell. Label maps are checked by the same code."""
    whole = encoded(PICTURE, form)
    for length in range(0, len(whole) - 12, 11):
        refuses(r".", decode_image, whole[:length])
    path = tmp_path / "a.png"
    whole = encoded(SMOOTH, form)
    for position in range(0, whole.index(b"IEND") - 4 if form == "PNG" else 0):
        path.write_bytes(whole)
        flip_byte(path, position)
        refuses(r".", read, path)


@pytest.mark.parametrize("form", ["TIFF", "PNG", "WEBP"])
def test_pictures_in_one_file_that_could_be_frames_are_refused(tmp_path, form):
    refuses("has 4 pages; expected one", read, write_pages(tmp_path / "a.png", form))


def test_a_second_picture_in_a_jpeg_of_a_telephone_is_no_frame():
    other = {"save_all": True, "append_images": [Image.fromarray(PICTURE)]}
    assert np.abs(decode_image(encoded(SMOOTH, "MPO", **other)).astype(int) - SMOOTH).max() < 40


TWELVE = np.linspace(0, 4095, 600).reshape(20, 30).astype(np.uint16)
DIGITS = (TWELVE[..., None] >> np.arange(11, -1, -1) & 1).reshape(20, -1)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_pictures_of_few_bits_in_pixels_of_sixteen_are_refused(bits, tmp_path):
    """Their high bytes would be black."""
    wide = TWELVE >> (12 - bits)
    refuses(f"of {bits} bits in pixels of 16", decode_image, encoded(wide, "PNG"))
    path = write_png(tmp_path / "a.png", np.dstack([wide] * 3), COLOUR, 16)
    refuses(f"of {bits} bits in pixels of 16", read, path)


def with_significant_bits(content, bits):
    chunk = b"sBIT" + bytes([bits])
    whole = struct.pack(">I", 1) + chunk + struct.pack(">I", crc32(chunk))
    return content[:33] + whole + content[33:]


@pytest.mark.parametrize(
    "content",
    [
        with_significant_bits(encoded(TWELVE, "PNG"), 12),
        encoded(TWELVE, "TIFF", tiffinfo={281: 4095}),
        tiff_bytes(20, 30, np.packbits(DIGITS, axis=1).tobytes(), bits=12),
        b"P5 30 20 4095\n" + TWELVE.astype(">u2").tobytes(),
    ],
    ids=["sBIT", "MaxSampleValue", "BitsPerSample", "maxval"],
)
def test_gray_has_the_bits_that_its_file_states(content):
    difference = decode_image(content)[..., 0].astype(int) - (TWELVE >> 4)
    assert np.abs(difference).max() <= 1


# ---- which files are frames


@pytest.mark.filterwarnings("error")
def test_a_label_map_is_refused_as_a_photograph():
    ids = np.array([0, 1, 18, 255], np.uint8).repeat(5)[None].repeat(20, 0)
    refuses("a photograph, got a label map: 3 values, 0 to 18", decode_image, encoded(ids, "PNG"))
    black, gray, column = ids * 0, (ids // 3 * 5), ids[:, :1]
    night = np.random.default_rng(0).integers(0, 39, (20, 20), np.uint8)
    for picture in (black, gray, night, column, np.stack([ids] * 3, 2)):
        assert decode_image(encoded(picture, "PNG")).shape == (20, picture.shape[1], 3)


@pytest.mark.parametrize("orientation", [1, 6])
def test_an_image_of_pillow_gives_the_pixels_of_its_file(tmp_path, orientation):
    """In 16 bits, with transparency, and turned by its EXIF tag."""
    rng = np.random.default_rng(0)
    for number, array in enumerate((
        rng.integers(0, 1 << 16, (8, 6), np.uint16),
        rng.integers(0, 256, (8, 6, 4), np.uint8),
        rng.integers(0, 256, (8, 6, 3), np.uint8),
    )):  # fmt: skip
        path = tmp_path / f"{number}.png"
        Image.fromarray(array).save(path, **turned(orientation))
        with Image.open(path) as image:
            np.testing.assert_array_equal(pixels_of(image), pixels_of(path))
    refuses("got mode F", pixels_of, Image.fromarray(np.zeros((8, 6), np.float32)))
