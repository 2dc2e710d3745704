"""Data sets as such: choosing sequences, attaching label maps, saying what is missing."""

import math
from pathlib import Path

import pytest
from helpers import refuses, touch
from trees import outline, plant

from ssrvlad_torch.datasets.dataset import (
    Dataset,
    DatasetFrame,
    GroundTruth,
)
from ssrvlad_torch.datasets.poses import UNKNOWN, Pose

HERE = Pose(1, 2, 0.5)


def made(*frames, root=Path("root"), **fields):
    return Dataset("made", root, tuple(frames), **fields)


def sequence(name, *frames, **fields):
    return [DatasetFrame(name, frame, **fields) for frame in frames]


def photos(root, *names):
    """A data set of images that are on disk, one sequence a folder."""
    plant(root, *names)
    paths = [root / name for name in names]
    folders = ("-".join(Path(name).parent.parts) for name in names)
    frames = (DatasetFrame(f, path.stem, path) for f, path in zip(folders, paths, strict=True))
    return made(*frames, root=root)


DAYS = made(
    *sequence("dawn-rear", "1", role="query"),
    *sequence("dawn-left", "1", role="query"),
    *sequence("map-rear", "1", "2", role="reference"),
)


@pytest.mark.parametrize(
    ("patterns", "role", "names"),
    [
        ((), None, ["dawn-rear", "dawn-left", "map-rear"]),
        ((), "query", ["dawn-rear", "dawn-left"]),
        (("*-rear",), None, ["dawn-rear", "map-rear"]),
        (("*-rear",), "reference", ["map-rear"]),
        (("map-rear", "dawn-l?ft"), None, ["dawn-left", "map-rear"]),
    ],
)
def test_sequences_are_chosen_by_pattern_and_role(patterns, role, names):
    assert DAYS.select(patterns, role).sequences == names


def test_frames_without_pose_are_dropped_when_asked():
    poses = (HERE, UNKNOWN, Pose(1, math.nan, 0))
    frames = [DatasetFrame("a", f"{n}", pose=pose) for n, pose in enumerate(poses)]
    assert outline(made(*frames).posed()) == {"a": ["0"]}
    refuses(r"no frame of root \(made\) has a pose", made(frames[1]).posed)


FRAMES = (
    DatasetFrame("a", "1", Path("1.jpg"), Path("1.png"), HERE),
    DatasetFrame("a", "2", None, Path("2.png")),
    DatasetFrame("a", "3", Path("3.jpg"), None, HERE),
)


def test_files_carry_id_and_pose():
    labels, images = made(*FRAMES).files("label"), made(*FRAMES).files("image")
    assert [(f.frame, f.path, f.pose) for f in labels] == [
        ("a/1", Path("1.png"), HERE),
        ("a/2", Path("2.png"), UNKNOWN),
    ]
    assert [(f.frame, f.path) for f in images] == [("a/1", Path("1.jpg")), ("a/3", Path("3.jpg"))]
    refuses(r"root \(made\) has no label maps; segment", made(FRAMES[2]).files, "label")
    refuses(r"root \(made\) has no images", made(FRAMES[1]).files, "image")


def test_what_only_some_frames_lack_is_counted():
    assert made(*FRAMES, notes=("no vehicle",)).warnings == [
        "no vehicle",
        "1 of 3 frames have no image, the first is a/2",
        "1 of 3 frames have no label map, the first is a/3",
        "1 of 3 frames have no pose, the first is a/2",
    ]
    assert made(FRAMES[1]).warnings == []


@pytest.mark.parametrize(
    "place",
    [
        "out/night-rear/1.png",  # by sequence
        "out/night/rear/1.png",  # as the images lie
        "out/1.png",  # all in one folder
        "out/night-rear/1.npy",
    ],
)
def test_label_maps_are_found_where_networks_write_them(tmp_path, place):
    dataset = photos(tmp_path / "data", "night/rear/1.jpg", "night/rear/2.jpg")
    touch(tmp_path / place)
    labelled = dataset.with_labels(tmp_path / "out", "camvid-11")
    assert labelled.labels_as == "camvid-11"
    assert [frame.label for frame in labelled.frames] == [tmp_path / place, None]
    assert labelled.warnings == ["1 of 2 frames have no label map, the first is night-rear/2"]
    assert [file.path for file in labelled.files("label")] == [tmp_path / place]


def test_label_maps_are_found_in_a_folder_beside_that_of_the_images(tmp_path):
    dataset = photos(tmp_path, "0001TP/images/1.jpg", "0016E5/images/1.jpg")
    expected = [tmp_path / f"{drive}/predicted/1.png" for drive in ("0001TP", "0016E5")]
    touch(*expected)
    labelled = dataset.with_labels("predicted", "camvid-11")
    assert [frame.label for frame in labelled.frames] == expected


def test_one_folder_for_all_is_not_taken_where_names_are_ambiguous(tmp_path):
    """The one 1.png must not become the label map of two frames."""
    dataset = photos(tmp_path / "data", "query/1.jpg", "ref/1.jpg")
    touch(tmp_path / "out/1.png")
    with pytest.raises(ValueError, match=r"out holds no label map .*out/query/1\.png"):
        dataset.with_labels(tmp_path / "out", "camvid-11")


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((None, None, None, None), GroundTruth(metres=5, degrees=30)),
        ((None, None, 10, None), GroundTruth(metres=5, degrees=10)),
        ((None, 7, None, None), GroundTruth(metres=7)),
        ((None, None, None, 1), GroundTruth(frames=1)),
    ],
)
def test_a_definition_of_the_user_replaces_the_declared_one(settings, expected):
    assert GroundTruth.chosen(GroundTruth(metres=5, degrees=30), *settings) == expected
    refuses("expected one of", GroundTruth.chosen, None, None, None, None, None)
