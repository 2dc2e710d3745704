"""The layout of SYNTHIA's video sequences."""

import math

import numpy as np
import pytest
from helpers import COLOUR, refused, write_png
from trees import outline, plant, roles, write

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.datasets.synthia import read_pose
from ssrvlad_torch.encoding.encoder import encode_to_memory

FRONT = "Stereo_Left/Omni_F"
LABELS = np.arange(30 * 40).reshape(30, 40) // 100 % 13


def write_labels(path, labels=LABELS):
    """As the data set has them: 16-bit channels, the class, the instance, and one of zeros."""
    path.parent.mkdir(parents=True, exist_ok=True)
    instances = np.random.default_rng(0).integers(0, 1 << 16, labels.shape)
    return write_png(path, np.stack((labels, instances, 0 * labels), axis=2), COLOUR, 16)


def matrix(x, y, z, yaw):
    """From camera to world, column by column: Unity's, of a level camera with z ahead at yaw 0,
    turned clockwise as seen from above. The columns are right, up, back and the position."""
    right = (math.cos(yaw), 0, -math.sin(yaw))
    back = (-math.sin(yaw), 0, -math.cos(yaw))
    columns = ((*right, 0), (0, 1, 0, 0), (*back, 0), (x, y, z, 1))
    return " ".join(f"{number:.6f}" for column in columns for number in column)


@pytest.fixture
def tree(tmp_path):
    """Two seasons of a front camera, of different lengths, one with a second camera."""
    root = tmp_path / "SYNTHIA"
    for season, count in (("NIGHT", 3), ("FALL", 4)):
        folder = root / f"SYNTHIA-SEQS-04-{season}"
        for number in range(count):
            write_labels(folder / f"GT/LABELS/{FRONT}/{number:06d}.png")
            plant(folder, f"RGB/{FRONT}/{number:06d}.png", f"GT/COLOR/{FRONT}/{number:06d}.png")
            place = folder / "CameraParams" / FRONT / f"{number:06d}.txt"
            write(place, matrix(2 * number, 1.5, 10, 0))
        write(folder / "CameraParams" / "intrinsics.txt", "532.740352\n\n640\n\n380\n\n0.8\n")
    plant(root / "SYNTHIA-SEQS-04-FALL", "RGB/Stereo_Right/Omni_B/000000.png")
    return root


def test_a_traverse_is_a_camera_in_a_season(tree):
    dataset = open_dataset(tree)
    assert (dataset.layout, dataset.labels_as) == ("synthia", "synthia")
    assert outline(dataset) == {
        "SYNTHIA-SEQS-04-FALL-Stereo_Left-Omni_F": [f"{n:06d}" for n in range(4)],
        "SYNTHIA-SEQS-04-FALL-Stereo_Right-Omni_B": ["000000"],
        "SYNTHIA-SEQS-04-NIGHT-Stereo_Left-Omni_F": [f"{n:06d}" for n in range(3)],
    }
    assert set(roles(dataset).values()) == {None}
    assert dataset.truth.metres == 7


def test_a_frame_has_its_image_its_labels_and_its_pose(tree):
    folder = tree / "SYNTHIA-SEQS-04-NIGHT"
    frame = list(open_dataset(folder).frames)[2]
    assert frame.frame == "SYNTHIA-SEQS-04-NIGHT-Stereo_Left-Omni_F/000002"
    assert frame.image == folder / "RGB" / FRONT / "000002.png"
    assert frame.label == folder / "GT" / "LABELS" / FRONT / "000002.png"
    assert frame.pose == pytest.approx((4, 10, math.pi / 2))


def test_a_season_is_encoded(tree):
    files = open_dataset(tree).select(["*-NIGHT-*"]).label_files()
    frames, skipped = encode_to_memory(SSRVLAD.from_preset("default", labels_as="synthia"), files)
    assert skipped == []
    assert frames.frames[0] == "SYNTHIA-SEQS-04-NIGHT-Stereo_Left-Omni_F/000000"
    np.testing.assert_allclose(frames.poses[:, :2], [[0, 10], [2, 10], [4, 10]])
    assert not frames.empty.any()


def test_what_is_missing_is_said(tree):
    where = "it is in the package at synthia-dataset.net (SYNTHIA-SEQS-<number>-<season>)"
    fall = tree / "SYNTHIA-SEQS-04-FALL"
    (fall / "CameraParams" / FRONT / "000001.txt").unlink()
    (fall / "GT" / "LABELS" / FRONT / "000003.png").unlink()
    right = "SYNTHIA-SEQS-04-FALL-Stereo_Right-Omni_B/000000"
    assert open_dataset(tree).warnings == [
        "2 of 8 frames have no label map, the first is SYNTHIA-SEQS-04-FALL-Stereo_Left-Omni_F/"
        "000003",
        "2 of 8 frames have no pose, the first is SYNTHIA-SEQS-04-FALL-Stereo_Left-Omni_F/000001",
    ]
    (fall / "GT").rename(fall / "elsewhere")
    (fall / "CameraParams").rename(fall / "nowhere")
    assert open_dataset(fall).warnings == [
        f"{fall} has no GT/LABELS; {where}",
        f"{fall} has no CameraParams; {where}",
    ]
    assert [file.frame for file in open_dataset(fall).image_files()][-1] == right


def test_label_maps_without_images_do(tree):
    fall = tree / "SYNTHIA-SEQS-04-FALL"
    (fall / "RGB").rename(fall / "elsewhere")
    assert len(open_dataset(fall).label_files()) == 4


@pytest.mark.parametrize(
    ("yaw", "heading"),
    [(0, math.pi / 2), (math.pi / 2, 0), (math.pi, -math.pi / 2), (-math.pi / 4, 3 * math.pi / 4)],
)
def test_headings(tmp_path, yaw, heading):
    """Yaw 0 looks along the world's z, which is a `Pose`'s y; a quarter turn clockwise, along x."""
    pose = read_pose(write(tmp_path / "000000.txt", matrix(3, 1, -4, yaw)))
    assert pose == pytest.approx((3, -4, heading))


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "expected 16 numbers, got 0"), ("1 " * 12, "got 12"), ("1 " * 15 + "x", "'x'")],
)
def test_damaged_poses_are_refused_by_file(tree, text, message):
    path = tree / "SYNTHIA-SEQS-04-FALL" / "CameraParams" / FRONT / "000002.txt"
    path.write_text(text)
    with refused(message, path):
        open_dataset(tree)
