"""Randomly damaged files for every reader: each is read, or refused by a ValueError or an OSError
within ten seconds. `test_random_run.py` tries many more."""

from collections.abc import Callable
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import ssrvlad_torch
from ssrvlad_torch import SSRVLADConfig, export_head
from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.datasets.label_files import read_label_map
from ssrvlad_torch.datasets.pose_tables import read_poses
from ssrvlad_torch.datasets.trajectories import read_trajectory
from ssrvlad_torch.datasets.videos import video_files
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.evaluation.ground_truth_files import from_file
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_files import load_model
from ssrvlad_torch.taxonomy import label_space as read_label_space

Reader = tuple[list[bytes], str, Callable[[Path], object]]
"""Good files, their suffix, and what reads one."""

ODD = (b"\0", b"\xff", b"\x7f", b"-1", b"1e999", b"nan", b"[" * 2000, b"\n", b"&a ", b"*a", b"!!")


def damaged(source: Random, good: list[bytes]) -> bytes:
    """A good file with one to four random changes."""
    content = bytearray(source.choice(good))
    for _ in range(source.randint(1, 4)):
        place = source.randint(0, len(content))
        match source.randint(0, 5):
            case 0:
                content[place : place + 1] = bytes([source.randint(0, 255)])
            case 1:
                del content[place:]
            case 2:
                del content[place : place + source.randint(1, 16)]
            case 3:
                content[place:place] = source.choice(ODD)
            case 4:
                other = source.choice(good)
                start = source.randint(0, len(other))
                content[place:] = other[start:]
            case 5:
                content[place:place] = content[place : place + source.randint(1, 64)]
    return bytes(content)


def _images(folder: Path, formats: tuple[str, ...], mode: str) -> list[bytes]:
    pixels = np.random.default_rng(0).integers(0, 12, (24, 32), dtype=np.uint8)
    image, contents = Image.fromarray(pixels).convert(mode), []
    for suffix in formats:
        image.save(folder / f"a.{suffix}")
        contents.append((folder / f"a.{suffix}").read_bytes())
    return contents


def _arrays(folder: Path, *arrays: np.ndarray) -> list[bytes]:
    contents = []
    for array in arrays:
        np.save(folder / "a.npy", array)
        contents.append((folder / "a.npy").read_bytes())
    return contents


def label_map(folder: Path) -> Reader:
    good = _images(folder, ("png", "tif", "bmp"), "L") + _arrays(folder, np.ones((9, 8), np.uint8))
    space = read_label_space("camvid-11")
    return good, ".png", lambda path: read_label_map(FrameFile("a", "b", path), space)


def image(folder: Path) -> Reader:
    good = _images(folder, ("jpg", "png", "webp", "ppm", "tif"), "RGB")
    return good, ".jpg", lambda path: read_image(FrameFile("a", "b", path))


def label_space(folder: Path) -> Reader:
    spaces = Path(ssrvlad_torch.__file__).parent / "label_spaces"
    return [file.read_bytes() for file in spaces.iterdir()], ".yaml", read_label_space


def segmenter(folder: Path) -> Reader:
    good = [
        b"network: a.onnx\nsize: [64, 128]\nmean: [0.5, 0.5, 0.5]\nstd: [1, 1, 1]\nwhite: 255\n",
        b"network: a.onnx\nlabels_as: camvid-11\nclasses: 0:11\nmultiple: 16\ncolour_order: bgr\n",
    ]
    return good, ".yaml", open_network


def poses(folder: Path) -> Reader:
    good = [
        b"frame,x,y,heading\na,1.5,2,0\nb,2.5,3,0.1\n",
        b"frame,latitude,longitude,course\na,50.1,8.2,10\nb,50.2,8.3,11\n",
    ]
    return good, ".csv", read_poses


def trajectory(folder: Path) -> Reader:
    kitti = " ".join(["1", "0", "0", "5"] * 3)
    good = [f"{kitti}\n{kitti}\n".encode(), b"0.1 1 2 3 0 0 0 1\n0.2 2 2 3 0 0 0 1\n"]
    return good, ".txt", read_trajectory


def track(folder: Path) -> Reader:
    point = b'<trkpt lat="48.5" lon="11.5"><time>1994-03-23T12:35:19Z</time></trkpt>'
    good = [b'<gpx version="1.1"><trk><trkseg>' + 2 * point + b"</trkseg></trk></gpx>"]
    return good, ".gpx", read_trajectory


def video(folder: Path) -> Reader:
    import av

    good = []
    for suffix in ("mp4", "mkv", "avi", "ts"):
        with av.open(str(folder / f"a.{suffix}"), "w") as container:
            stream = container.add_stream("mpeg4", rate=10)
            stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
            for number in range(5):
                pixels = np.full((32, 48, 3), 40 * number, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            container.mux(stream.encode())
        good.append((folder / f"a.{suffix}").read_bytes())

    def read(path: Path) -> None:
        for file in video_files(path):
            read_image(file)

    return good, ".mp4", read


def truth(folder: Path) -> Reader:
    good = [b'{"a": ["c"], "b": []}', b"query,reference\na,c\nb,\n"]
    good += [b"[[0, [0]], [1, [1, 0]]]", *_arrays(folder, np.eye(2))]
    suffixes = (".json", ".csv", ".npy")

    def read(path: Path) -> None:
        suffix = suffixes[path.stat().st_size % len(suffixes)]
        from_file(path.rename(path.with_suffix(suffix)), ["a", "b"], ["c", "d"])

    return good, ".json", read


def model(folder: Path) -> Reader:
    config = SSRVLADConfig.from_preset("default", labels_as="camvid-11")
    export_head(config, folder / "a.onnx")

    def read(path: Path) -> None:
        properties = {entry.key: entry.value for entry in load_model(path).metadata_props}
        Metadata.from_properties(properties).golden_arrays()

    return [(folder / "a.onnx").read_bytes()], ".onnx", read


READERS = (
    label_map, image, label_space, segmenter, poses, trajectory, track, video, truth, model
)  # fmt: skip


@pytest.fixture(scope="module")
def reader(request, tmp_path_factory):
    return request.param(tmp_path_factory.mktemp("good"))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("reader", READERS, indirect=True)
@given(source=st.randoms(use_true_random=False))
@settings(max_examples=30, deadline=10_000)
def test_a_damaged_file_is_read_or_refused(reader, source):
    good, suffix, read = reader
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"damaged{suffix}"
        path.write_bytes(damaged(source, good))
        try:
            read(path)
        except (ValueError, OSError) as error:
            assert str(error)
