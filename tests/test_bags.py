"""Pictures in ROS bags, which the library that reads them wrote."""

import io

import numpy as np
import pytest
from drawings import SPACE
from helpers import refuses, street
from networks import photo, write_graph
from PIL import Image

from ssrvlad_torch import Database
from ssrvlad_torch.datasets.image_files import find_image_files, read_image

rosbags = pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

FIRST = 1_700_000_000_000_000_000
PHOTOS = [photo(street(seed, 60, 80)) for seed in range(5)]
SHADOW = np.linspace(10, 240, 80)[None, :, None] + np.linspace(-9, 9, 60)[:, None, None]
SMOOTH = (SHADOW * (1, 0.8, 0.6)).clip(0, 255).astype(np.uint8)
"""Colours whose neighbours are alike: half of them can be left out."""


def yuv(pixels):
    """Luma of each pixel and, by turns, u and v of its pair, ``(H, W, 2)`` uint8, by Pillow."""
    luma, u, v = np.asarray(Image.fromarray(pixels).convert("YCbCr")).transpose(2, 0, 1)
    scaled = [16 + luma * (219 / 255), *(128 + (c - 128.0) * 224 / 255 for c in (u, v))]
    scaled[1][:, 1::2] = scaled[2][:, ::2]
    return np.stack(scaled[:2], -1).round().astype(np.uint8)


def mosaic(pixels, order):
    rows, columns = np.indices(pixels.shape[:2]) % 2
    channel = np.array(["rgb".index(colour) for colour in order])[2 * rows + columns]
    return np.take_along_axis(pixels, channel[..., None], 2)[..., 0]


FORMS = {
    "rgb8": lambda p: p,
    "bgr8": lambda p: p[..., ::-1],
    "rgba8": lambda p: np.dstack([p, p[..., :1]]),
    "bgra8": lambda p: np.dstack([p[..., ::-1], p[..., :1]]),
    "mono8": lambda p: p[..., 0],
    "mono16": lambda p: p[..., 0].astype("<u2") * 256 + 7,
    "mono12": lambda p: p[..., 0].astype("<u2") * 16,
    "16UC1": lambda p: p[..., 0].astype("<u2"),
    "rgb16": lambda p: p.astype("<u2") * 256 + 7,
    "8UC1": lambda p: p[..., 0],
    "8UC3": lambda p: p[..., ::-1],
    "yuv422": lambda p: yuv(p)[..., ::-1],
    "yuv422_yuy2": yuv,
    "bayer_rggb8": lambda p: mosaic(p, "rggb"),
    "bayer_gbrg16": lambda p: mosaic(p, "gbrg").astype("<u2") * 256 + 7,
}


def write_bag(
    path, topics, kind=1, padding=0, storage=rosbag2.StoragePlugin.SQLITE3, step=10**8,
    photos=PHOTOS,
):  # fmt: skip
    """A bag with every photo on each topic, in the encoding that the topic has."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    sequence = {"seq": 0} if kind == 1 else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **sequence)
    if kind == 1:
        writer = rosbag1.Writer(path)
    else:
        writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
    serialise = store.serialize_ros1 if kind == 1 else store.serialize_cdr
    with writer as bag:
        for topic, encoding in topics.items():
            name = f"sensor_msgs/msg/{'CompressedImage' if encoding == 'png' else 'Image'}"
            connection = bag.add_connection(topic, name, typestore=store)
            for row, pixels in enumerate(photos):
                if encoding == "png":
                    file = io.BytesIO()
                    Image.fromarray(pixels).save(file, "PNG")
                    fields = {"format": "png", "data": np.frombuffer(file.getvalue(), np.uint8)}
                else:
                    lines = FORMS[encoding](pixels).reshape(60, -1).view(np.uint8)
                    lines = np.pad(lines, ((0, 0), (0, padding)))
                    fields = {
                        "height": 60, "width": 80, "is_bigendian": 0,
                        "encoding": encoding.replace("mono12", "mono16"),
                        "step": lines.shape[1], "data": lines.reshape(-1),
                    }  # fmt: skip
                message = types[name](header=header, **fields)
                bag.write(connection, FIRST + row * step, serialise(message, name))
    return path


@pytest.mark.parametrize(
    "encoding",
    ["rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "mono8", "mono16", "8UC1", "8UC3", "png"],
)
def test_every_image_encoding_gives_the_picture(encoding, tmp_path):
    bag = write_bag(tmp_path / "drive.bag", {"/camera": encoding}, padding=3)
    files = find_image_files([str(bag)])
    assert [file.frame for file in files] == [f"drive/{FIRST + n * 10**8}" for n in range(5)]
    assert files[3].stamp == pytest.approx(FIRST * 1e-9 + 0.3)
    for row in (0, 4, 1, 1, 3):
        is_gray = encoding in ("mono8", "mono16", "8UC1")
        expected = PHOTOS[row][..., :1].repeat(3, 2) if is_gray else PHOTOS[row]
        np.testing.assert_array_equal(read_image(files[row]), expected)


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2", "bayer_rggb8", "bayer_gbrg16"])
def test_colours_that_a_pixel_lacks_are_those_of_its_neighbours(encoding, tmp_path):
    bag = write_bag(tmp_path / "a.bag", {"/camera": encoding}, padding=2, photos=[SMOOTH])
    (file,) = find_image_files([str(bag)])
    assert np.abs(read_image(file).astype(int) - SMOOTH)[1:-1, 1:-1].max() < 6


@pytest.mark.parametrize(("storage", "suffix"), [("SQLITE3", "db3"), ("MCAP", "mcap")])
def test_a_ros_2_bag_is_read_as_folder_or_file(tmp_path, storage, suffix):
    plugin = rosbag2.StoragePlugin[storage]
    folder = write_bag(tmp_path / "drive", {"/camera": "rgb8"}, kind=2, storage=plugin)
    for source in (folder, next(folder.glob(f"*.{suffix}"))):
        files = find_image_files([str(source)], every=2)
        assert [file.stamp - FIRST * 1e-9 for file in files] == pytest.approx([0, 0.2, 0.4])
        np.testing.assert_array_equal(read_image(files[1]), PHOTOS[2])
    assert files[0].sequence == "drive"


def test_a_topic_is_named_where_there_are_several_and_damage_is_refused(tmp_path):
    topics = {"/left": "rgb8", "/right": "mono8", "/depth": "16UC1"}
    path = write_bag(tmp_path / "drive.bag", topics)
    bag = str(path)
    refuses("2 topics of images, /left, /right; name one", find_image_files, [bag])
    with pytest.raises(ValueError, match="no topic /up of images; it has /depth, /left, /right"):
        find_image_files([bag], topic="/up")
    np.testing.assert_array_equal(read_image(find_image_files([bag], topic="/left")[0]), PHOTOS[0])
    unread = "/depth: image encoding: got '16UC1', expected one of rgb8, bgr8"
    refuses(unread, find_image_files, [bag], topic="/depth")
    other, notes = write_bag(tmp_path / "b.bag", {"/left": "rgb8", "/depth": "16UC1"}), []
    assert len(find_image_files([str(other)], note=notes.append)) == 5
    assert len(notes) == 1 and unread in notes[0]
    dark = write_bag(tmp_path / "dark.bag", {"/camera": "mono12"})
    refuses("of [1-9][0-9]? bits in pixels of 16", read_image, find_image_files([str(dark)])[0])
    path.write_bytes(path.read_bytes()[:50])
    refuses(r"drive\.bag is not a readable bag", find_image_files, [bag])


def test_messages_of_one_time_are_frames_with_numbers(tmp_path):
    files = find_image_files([str(write_bag(tmp_path / "a.bag", {"/camera": "rgb8"}, step=0))])
    assert [file.name for file in files] == [str(FIRST), *(f"{FIRST}-{n}" for n in range(1, 5))]
    np.testing.assert_array_equal(read_image(files[3]), PHOTOS[3])


def test_a_bag_is_encoded_as_one_sequence_with_poses(tmp_path, ssrvlad, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    network = write_graph(tmp_path / "net.onnx")
    bag = write_bag(tmp_path / "drive.bag", {"/left": "rgb8", "/right": "bgr8"})
    options = ("-o", tmp_path / "town", "--segmenter", network, "--labels-as", SPACE)
    options = (bag, *options, "--channel", "ssr-vlad")
    code, _, (*_, line) = ssrvlad("encode", *options)
    assert code == 2 and "/left, /right; name one with --topic" in line
    rows = [f"{FIRST * 1e-9 + n / 10:.9f} {n} 0 0 0 0 0 1" for n in range(5)]
    (tmp_path / "tum.txt").write_text("\n".join(rows))
    options = (*options, "--topic", "/left", "--poses", tmp_path / "tum.txt")
    assert "5 frames encoded" in ssrvlad("encode", *options)[1]
    assert "0 frames encoded" in ssrvlad("encode", *options)[1]
    frames = Database.open(tmp_path / "town").load()
    assert frames.poses[:, 0].tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(frames.stamps - FIRST * 1e-9, np.arange(5) / 10, atol=1e-6)
