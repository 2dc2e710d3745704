"""Which files the programs without torch take, and how they read them: as `ssrvlad encode` does."""

import numpy as np
import pytest
from helpers import refuses, touch
from PIL import Image
from ssrvlad_place.frames import find_frames, read_labels, read_photograph
from ssrvlad_place.model import Model

from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.image_files import decode_image, find_image_files
from ssrvlad_torch.datasets.label_files import SUFFIXES as SUFFIXES_OF_MAPS
from ssrvlad_torch.datasets.label_files import read_label_map
from ssrvlad_torch.datasets.names import IMAGE_SUFFIXES
from ssrvlad_torch.taxonomy import label_space


def test_frames_of_a_folder_are_in_natural_order_however_they_are_named(tmp_path):
    """A shell gives 10 before 9. Two folders of one name would be one drive."""
    files = [tmp_path / day / "maps" / f"{n}.png" for day in ("a", "b") for n in (10, 8, 9)]
    touch(*files)
    for sources in (files[:3], [files[0].parent], [files[0], files[0].parent / ".." / "maps"]):
        frames = [frame for frame, _ in find_frames(sources)]
        assert list(dict.fromkeys(frames)) == ["maps/8", "maps/9", "maps/10"]
    refuses(r"a.maps and .*b.maps have one name", list, find_frames(files))
    drive = tmp_path / "drive"
    unusual = ["b\u00b2", "b1\u00b2", "c\u0663", "\u00bd"]
    names = ["b2", "b10", "12.5", "12.25", "9", "c2", "_", *unusual]
    touch(*(drive / f"{name}.png" for name in names))
    expected = [file.frame for file in find_image_files([str(drive)])]
    assert [frame for frame, _ in find_frames([drive])] == expected


def test_frames_have_the_suffixes_that_encode_takes(head, drives, tmp_path):
    assert Model(head).suffixes == SUFFIXES_OF_MAPS
    assert Model(drives / "place.onnx").suffixes == IMAGE_SUFFIXES
    touch(*(tmp_path / f"a{suffix}" for suffix in IMAGE_SUFFIXES))
    found = [path.suffix for _, path in find_frames([tmp_path], SUFFIXES_OF_MAPS)]
    assert sorted(found) == sorted(SUFFIXES_OF_MAPS)


GRAYS = np.random.default_rng(0).integers(0, 256, (6, 9), np.uint8)
WIDE = GRAYS.astype(np.uint16) << 8 | 77
TURNED = Image.Exif()
TURNED[0x0112] = 6


def two_pages():
    return {"save_all": True, "append_images": [Image.fromarray(GRAYS[::-1])]}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("pixels", "form", "options"),
    [
        (WIDE, "PNG", {}),
        (WIDE, "TIFF", {"exif": TURNED}),
        (WIDE >> 3, "PNG", {}),
        (WIDE >> 4, "PNG", {}),
        (WIDE * 0, "PNG", {}),
        (GRAYS, "TIFF", {"exif": TURNED}),
        (GRAYS, "TIFF", two_pages()),
        (GRAYS, "PNG", two_pages()),
        (np.dstack([GRAYS] * 3), "WEBP", two_pages()),
        (np.dstack([GRAYS] * 3), "MPO", two_pages()),
        (GRAYS, "PNG", {"exif": TURNED}),
        (GRAYS, "PPM", {}),
        (np.dstack([GRAYS] * 3), "WEBP", {"lossless": True}),
        (np.dstack([GRAYS] * 4), "PNG", {}),
        (GRAYS[:, :1], "PNG", {}),
        (GRAYS.astype(np.int32), "TIFF", {}),
        (GRAYS.astype(np.float32), "TIFF", {}),
        (GRAYS, "GIF", {}),
        (np.zeros((0, 5, 3), np.uint8), "npy", {}),
    ],
)
def test_photographs_are_read_as_by_encode(tmp_path, pixels, form, options):
    path = tmp_path / ("a.npy" if form == "npy" else "a.png")
    if form == "npy":
        np.save(path, pixels)
    else:
        Image.fromarray(pixels).save(path, form, **options)
    try:
        expected = decode_image(path.read_bytes())
    except ValueError:
        refuses(r"^(.*; )?expected ", read_photograph, path)
    else:
        np.testing.assert_array_equal(read_photograph(path), expected)


@pytest.mark.parametrize("form", ["PNG", "TIFF", "BMP"])
def test_label_maps_are_read_as_by_encode(tmp_path, form):
    """Pillow turns a TIFF by its orientation tag, if it does not map it into memory."""
    space, path = label_space("camvid-11"), tmp_path / "a.png"
    for pixels in (GRAYS, WIDE) if form != "BMP" else (GRAYS,):
        Image.fromarray(pixels).save(path, form, **({} if form == "BMP" else {"exif": TURNED}))
        expected = read_label_map(FrameFile("", "a", path), space)
        np.testing.assert_array_equal(read_labels(path, [], np.uint16), expected)


def test_several_pages_are_no_label_map(tmp_path):
    Image.fromarray(GRAYS).save(tmp_path / "a.tif", **two_pages())
    refuses("has 2 pages; expected one", read_labels, tmp_path / "a.tif", [], np.uint8)


@pytest.mark.parametrize("shape", [(6, 9, 1), (1, 6, 9), (6, 9, 4), (2, 6, 9)])
def test_an_array_is_one_label_map_or_refused(tmp_path, shape):
    """Of arrays with three axes that with one value a pixel is a label map."""
    path, space = tmp_path / "a.npy", label_space("camvid-11")
    np.save(path, np.resize(GRAYS, shape))
    if shape == (6, 9, 1):
        expected = read_label_map(FrameFile("", "a", path), space)
        np.testing.assert_array_equal(read_labels(path, [], np.uint8), expected)
    else:
        refuses(r"expected an \(H, W\) label map", read_labels, path, [], np.uint8)
