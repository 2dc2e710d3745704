"""Label maps on disk: which files are frames, and what each format holds."""

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


def touch(*paths):
    """Empty files: finding does not look into images."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def ids(files):
    return [file.frame for file in files]


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


# ---- what a file holds


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


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bit_gray_holds_ids(tmp_path, suffix):
    labels = LABELS.astype(np.uint16) + 1000
    Image.fromarray(labels).save(tmp_path / f"a{suffix}")
    found = read(tmp_path / f"a{suffix}")
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, labels)


def test_thirty_two_bit_images_hold_ids(tmp_path):
    labels = LABELS.astype(np.int32) + 100_000
    Image.fromarray(labels).save(tmp_path / "a.tif")
    np.testing.assert_array_equal(read(tmp_path / "a.tif"), labels)


def test_the_other_byte_order_is_turned(tmp_path):
    """Torch takes only the machine's own."""
    labels = LABELS.astype(np.uint16) + 1000
    height, width = labels.shape
    Image.frombytes("I;16B", (width, height), labels.astype(">u2").tobytes()).save(
        tmp_path / "a.tif"
    )
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


def test_sixteen_bit_colour_of_opencv_holds_the_class_in_red(tmp_path):
    pixels = beside(LABELS, *"gb")
    cv2.imwrite(str(tmp_path / "a.png"), pixels[..., ::-1])
    np.testing.assert_array_equal(read(tmp_path / "a.png"), LABELS)


def test_eight_bit_gray_with_alpha_holds_the_class_first(tmp_path):
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
    with (tmp_path / f"stack{suffix}").open("wb") as file:
        np.save(file, stack)
    files = find_label_files([str(tmp_path / f"stack{suffix}")])
    assert ids(files) == ["stack/stack-000000", "stack/stack-000001", "stack/stack-000002"]
    for file, labels in zip(files, stack, strict=True):
        np.testing.assert_array_equal(read_label_map(file, CAMVID), labels)


def array(content):
    return lambda path: np.save(path, content, allow_pickle=True)


def image(pixels, **options):
    return lambda path: Image.fromarray(pixels).save(path, format="PNG", **options)


def other_format(name):
    return lambda path: Image.fromarray(LABELS).save(path, format=name)


def zipped(path):
    with path.open("wb") as file:
        np.savez(file, LABELS)


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("missing.png", lambda path: None, "No such file"),
        ("missing.npy", lambda path: None, "No such file"),
        ("zero.png", lambda path: path.touch(), "cannot identify"),
        ("zero.npy", lambda path: path.touch(), "."),
        ("text.png", lambda path: path.write_text("hello"), "cannot identify"),
        ("text.npy", lambda path: path.write_text("hello"), "magic string"),
        ("photo.png", other_format("JPEG"), "cannot identify"),
        ("zip.npy", zipped, "magic string"),
        ("float.npy", array(LABELS / 2), r"integer label map, got \(24, 32\) float64"),
        ("bool.npy", array(LABELS > 3), "integer label map, got .* bool"),
        ("float.png", lambda path: Image.fromarray(LABELS / 2).save(path, "TIFF"), "mode F"),
        ("four.npy", array(np.zeros((2, 3, 4, 5), int)), r"got \(2, 3, 4, 5\)"),
        ("one.npy", array(np.zeros(5, int)), r"got \(5,\)"),
        ("nothing.npy", array(np.zeros((0, 5), int)), r"got \(0, 5\)"),
        ("pickle.npy", array(np.array([[{"id": 3}]])), "holds Python objects"),
        ("bilevel.png", image(LABELS > 3), "mode 1"),
    ],
)
def test_what_is_no_label_map_is_refused_in_one_line(tmp_path, name, write, message):
    write(tmp_path / name)
    with pytest.raises(ValueError, match=message) as refusal:
        read(tmp_path / name)
    assert str(refusal.value)
    assert "\n" not in str(refusal.value)


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


def test_a_damaged_header_of_an_array_is_refused(tmp_path):
    """NumPy parses it as Python: among others it raises tokenize.TokenError."""
    path = tmp_path / "a.npy"
    np.save(path, LABELS[None])
    whole = path.read_bytes()
    refused = 0
    for position in range(128):
        path.write_bytes(whole)
        flip_byte(path, position)
        (file,) = find_label_files([str(path)])
        try:
            read_label_map(file, CAMVID)
        except ValueError:
            refused += 1
    assert refused > 64


def test_a_stack_that_became_shorter_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", LABELS[None])
    with pytest.raises(ValueError, match="index 1 is out of bounds"):
        read(tmp_path / "a.npy", row=1)


def test_a_name_that_is_no_text_is_refused(tmp_path):
    """A database could not hold it."""
    path = tmp_path / os.fsdecode(b"\xff.png")
    Image.fromarray(LABELS).save(path)
    (file,) = find_label_files([str(path)])
    with pytest.raises(ValueError, match="surrogates not allowed"):
        read_label_map(file, CAMVID)


def test_the_digest_is_of_the_ids_and_the_shape_and_not_of_the_format():
    assert digest(LABELS) == digest(np.asfortranarray(LABELS.astype(np.int64)))
    assert digest(LABELS) == digest(LABELS.astype(">u2"))
    assert len(digest(LABELS)) == 32
    other = LABELS.copy()
    other[5, 5] += 1
    different = [
        LABELS,
        other,
        LABELS.reshape(32, 24),
        LABELS + np.uint16(256),
        -LABELS.astype(int),
    ]
    assert len({digest(labels) for labels in different}) == len(different)


# ---- which files are frames


def test_the_files_of_a_folder_are_a_sequence_in_the_order_of_a_person(tmp_path):
    folder = tmp_path / "monday"
    touch(*(folder / name for name in ("f10.png", "f2.png", "f1.tif", "f3.PNG", "f01.bmp")))
    touch(folder / "notes.txt", folder / "poses", folder / "below" / "f5.png")
    (folder / "f6.png").mkdir()
    expected = ["monday/f01", "monday/f1", "monday/f2", "monday/f3", "monday/f10"]
    assert ids(find_label_files([str(folder)])) == expected
    assert ids(find_label_files([f"{folder}/"])) == expected


def test_hidden_files_and_halves_are_no_frames(tmp_path):
    touch(*(tmp_path / "a" / name for name in ("1.png", "._1.png", ".2.png", ".3.png.part")))
    assert ids(find_label_files([str(tmp_path / "a")])) == ["a/1"]


def test_weird_names_are_kept(tmp_path):
    names = ["C:\\maps\\1.png", "straße 3 🚗.png", "a.b.c.png", "[x]*?.png"]
    touch(*(tmp_path / "[a]" / name for name in names))
    files = find_label_files([str(tmp_path / "[a]")])
    assert {file.name for file in files} == {name.removesuffix(".png") for name in names}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (".", "monday/1"),
        ("./", "monday/1"),
        ("1.png", "monday/1"),
        ("*.png", "monday/1"),
        ("../monday", "monday/1"),
        ("..", "maps/2"),
        ("../tuesday/..", "maps/2"),
        ("../tuesday/../monday", "monday/1"),
    ],
)
def test_a_relative_folder_gives_its_real_name(tmp_path, monkeypatch, source, expected):
    maps = tmp_path / "maps"
    touch(maps / "monday" / "1.png", maps / "2.png", maps / "tuesday" / "3.png")
    monkeypatch.chdir(maps / "monday")
    assert ids(find_label_files([source])) == [expected]


def test_a_link_to_a_folder_gives_its_own_name(tmp_path):
    touch(tmp_path / "0001" / "1.png")
    (tmp_path / "monday").symlink_to(tmp_path / "0001")
    assert ids(find_label_files([str(tmp_path / "monday")])) == ["monday/1"]


def test_a_link_to_nothing_is_a_frame_that_is_refused_by_name(tmp_path):
    (tmp_path / "1.png").symlink_to(tmp_path / "gone.png")
    (file,) = find_label_files([str(tmp_path)])
    with pytest.raises(ValueError, match="No such file"):
        read_label_map(file, CAMVID)


def test_globs(tmp_path):
    touch(*(tmp_path / "a" / name for name in ("1.png", "2.png", "2.txt", "x.png")))
    touch(tmp_path / "b" / "1.png", tmp_path / "b" / "c" / "1.png")
    find = lambda pattern: ids(find_label_files([str(tmp_path / pattern)]))  # noqa: E731
    assert find("a/[0-9]*") == ["a/1", "a/2"]
    assert find("?/1.png") == ["a/1", "b/1"]
    assert find("**/1.png") == ["a/1", "b/1", "c/1"]
    assert find("**") == ["a/1", "a/2", "a/x", "b/1", "c/1"]


def test_a_glob_of_folders_is_these_folders(tmp_path):
    touch(tmp_path / "a" / "1.png", tmp_path / "b" / "1.png", tmp_path / "b" / "c" / "1.png")
    touch(tmp_path / "ground_truth.json")
    assert ids(find_label_files([str(tmp_path / "*")])) == ["a/1", "b/1"]


def test_a_glob_is_what_a_shell_would_have_made_of_it(tmp_path):
    for name in ("x", "y"):
        np.save(tmp_path / f"{name}.npy", LABELS[None])
    by_shell = find_label_files([str(tmp_path / "x.npy"), str(tmp_path / "y.npy")])
    assert find_label_files([str(tmp_path / "*.npy")]) == by_shell
    assert ids(by_shell) == ["x/x-000000", "y/y-000000"]


def test_arrays_and_stacks_in_a_folder_belong_to_its_sequence(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    np.save(folder / "one.npy", LABELS)
    np.save(folder / "two.npy", np.stack([LABELS] * 2))
    assert ids(find_label_files([str(folder)])) == ["a/one", "a/two-000000", "a/two-000001"]


def test_the_sequence_may_be_named(tmp_path):
    touch(tmp_path / "a" / "1.png")
    np.save(tmp_path / "stack.npy", LABELS[None])
    sources = [str(tmp_path / "a"), str(tmp_path / "stack.npy")]
    assert ids(find_label_files(sources, "drive")) == ["drive/1", "drive/stack-000000"]


def test_every_and_start_count_in_each_sequence(tmp_path):
    for name in "ab":
        touch(*(tmp_path / name / f"{number}.png" for number in range(8)))
    sources = [str(tmp_path / name) for name in "ab"]
    files = find_label_files(sources, every=3, start=1)
    assert ids(files) == ["a/1", "a/4", "a/7", "b/1", "b/4", "b/7"]
    assert ids(find_label_files(sources[:1], every=100)) == ["a/0"]


@pytest.mark.parametrize(("every", "start"), [(0, 0), (-1, 0), (1, -1)])
def test_every_and_start_out_of_range(tmp_path, every, start):
    touch(tmp_path / "1.png")
    with pytest.raises(ValueError, match=f"got {every} and {start}"):
        find_label_files([str(tmp_path)], every=every, start=start)


def test_one_file_given_twice_is_one_frame(tmp_path, monkeypatch):
    touch(tmp_path / "a" / "1.png")
    monkeypatch.chdir(tmp_path / "a")
    sources = [".", "../a", "1.png", str(tmp_path / "a" / "*.png")]
    assert ids(find_label_files(sources)) == ["a/1"]


def test_one_frame_of_two_folders_of_one_sequence_is_refused(tmp_path):
    touch(tmp_path / "x" / "a" / "1.png", tmp_path / "y" / "a" / "1.png")
    sources = [str(tmp_path / "x" / "a"), str(tmp_path / "y" / "a")]
    with pytest.raises(ValueError, match=r"frame 'a/1' is both .*x/a/1\.png and .*y/a/1\.png"):
        find_label_files(sources, sequence="a")
    assert ids(find_label_files(sources)) == ["x/a/1", "y/a/1"]


def test_one_frame_of_two_formats_is_refused(tmp_path):
    touch(tmp_path / "1.png", tmp_path / "1.tif")
    with pytest.raises(ValueError, match="is both"):
        find_label_files([str(tmp_path)])


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("missing", "missing does not exist and matches no file"),
        ("missing/*.png", "does not exist and matches no file"),
        ("empty", r"empty holds no label maps; expected \.png"),
        ("others", "others holds no label maps"),
        ("others/a.txt", "a.txt holds no label maps"),
        ("others/*", "holds no label maps"),
        ("stack", "stack holds no label maps"),
    ],
)
def test_a_source_without_label_maps_is_refused_by_name(tmp_path, source, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "stack").mkdir()
    np.save(tmp_path / "stack" / "none.npy", np.zeros((0, 4, 4), np.uint8))
    touch(tmp_path / "others" / "a.txt", tmp_path / "others" / "b.jpg")
    with pytest.raises(ValueError, match=message):
        find_label_files([str(tmp_path / source)])


def test_poses_are_found_by_id_and_by_name(tmp_path):
    folder = tmp_path / "a"
    touch(*(folder / f"{number}.png" for number in range(4)))
    (folder / "poses.csv").write_text("frame,x,y,heading\na/0,1,2,3\n1,4,5,6\nb/2,7,8,9\n")
    poses = [file.pose for file in find_label_files([str(folder)])]
    assert poses[:2] == [(1, 2, 3), (4, 5, 6)]
    assert np.isnan(poses[2:]).all()


def test_names_in_poses_may_have_the_suffix_of_the_file(tmp_path):
    touch(tmp_path / "a" / "0.png", tmp_path / "a" / "1.png")
    (tmp_path / "a" / "poses.csv").write_text("frame,x,y\n0.png,1,2\na/1.png,3,4\n")
    for files in (
        find_label_files([str(tmp_path / "a")]),
        find_label_files([str(tmp_path / "a")], poses=str(tmp_path / "a" / "poses.csv")),
    ):
        assert [file.pose[:2] for file in files] == [(1, 2), (3, 4)]


def test_an_id_in_poses_goes_before_a_bare_name(tmp_path):
    touch(tmp_path / "a" / "0.png", tmp_path / "b" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x,y\n0,1,1\nb/0,2,2\n")
    files = find_label_files([str(tmp_path / "a"), str(tmp_path / "b")])
    assert [file.pose.x for file in files] == [1, 2]


def test_a_sequence_that_is_named_anew_keeps_its_poses(tmp_path):
    touch(tmp_path / "a" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x,y\na/0,1,2\n")
    (file,) = find_label_files([str(tmp_path / "a")], sequence="drive")
    assert file.pose[:2] == (1, 2)


def test_poses_of_a_stack(tmp_path):
    np.save(tmp_path / "s.npy", np.stack([LABELS] * 2))
    (tmp_path / "poses.csv").write_text("frame,x,y\ns/s-000001,1,2\ns-000000,3,4\n")
    files = find_label_files([str(tmp_path / "s.npy")])
    assert [file.pose.x for file in files] == [3, 1]


def test_damaged_poses_are_refused_before_anything_is_read(tmp_path):
    touch(tmp_path / "a" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x\n")
    with pytest.raises(ValueError, match=r"poses\.csv.*no column 'y'"):
        find_label_files([str(tmp_path / "a")])
