"""Data sets as such: choosing sequences, attaching label maps, saying what is missing."""

import math
from pathlib import Path

import pytest
from helpers import refuses, touch
from layout_copies import outline, plant, roles, write

from ssrvlad_torch.datasets.dataset import Dataset, DatasetFrame, GroundTruth
from ssrvlad_torch.datasets.label_files import SUFFIXES as LABEL_SUFFIXES
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.datasets.names import IMAGE_SUFFIXES, check_sequences, sequence_names
from ssrvlad_torch.datasets.poses import UNKNOWN, Pose
from ssrvlad_torch.datasets.synthetic_city import write_city

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


# ---- names of sequences: short, and never two alike


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["/data/monday"], ["monday"]),
        (["s3://bucket/monday"], ["monday"]),
        (["/d/00/labels", "/d/01/labels", "/d/park"], ["00/labels", "01/labels", "park"]),
        (["/a/x/y", "/b/x/y"], ["a/x/y", "b/x/y"]),
        (["/d/day.npy", "/d/run.v2.bag"], ["day", "run.v2"]),
    ],
)
def test_folders_take_as_much_of_their_paths_as_they_need(folders, names):
    assert sequence_names(folders) == dict(zip(folders, names, strict=True))


def test_folders_that_would_share_a_name_are_refused():
    """A path that ends another; a stack, a bag or a video, and the folder beside it."""
    refuses("/y needs a name that no sequence has", sequence_names, ["/y", "/b/y"])
    for suffix in (".npy", ".bag", ".mp4"):
        refuses("needs a name that no sequence has", sequence_names, ["/d/day", f"/d/day{suffix}"])
        with pytest.raises(ValueError, match=rf"'day' of the database is /d/day, not .*{suffix}"):
            check_sequences([(f"/d/day{suffix}", "day")], [("/d/day", "day")])


def test_folders_of_the_map_keep_their_names(tmp_path):
    """By a link too. The name of another is the same if it comes with the known ones or later."""
    (tmp_path / "monday").mkdir()
    (tmp_path / "link").symlink_to("monday")
    link, other = str(tmp_path / "link"), "/other/labels"
    folders = [(str(tmp_path / "monday"), "labels")]
    assert sequence_names([other, link], folders) == {other: "other/labels", link: "labels"}
    folders = [("s3://d/00/labels", "00/labels"), ("s3://d/01/labels", "01/labels")]
    assert sequence_names(["s3://d/02/labels"], folders) == {"s3://d/02/labels": "02/labels"}


@pytest.mark.parametrize(
    ("folders", "message"),
    [
        (
            [("/none/labels", "labels")],
            "'labels' of the database was encoded from /none/labels, wh",
        ),
        ([("", "labels")], "'labels' of the database has no known folder: .* --sequence labels"),
        (
            [("/other/labels", "even"), ("/other/labels", "odd")],
            "/other/labels is sequence 'even' and sequence 'odd' of the database: .* --sequence",
        ),
    ],
)
def test_a_folder_that_may_be_two_sequences_is_refused(folders, message):
    refuses(message, sequence_names, ["/other/labels"], folders)


def test_sequences_of_two_databases_are_one_where_a_folder_is():
    here = [("s3://a/day", "labels"), ("s3://a/night", "labels"), ("", "own")]
    check_sequences([("s3://a/day", "labels"), ("s3://c", "c"), ("s3://d", "own")], here)
    with pytest.raises(ValueError, match="'labels' of the database is s3://a/day, not s3://b/day"):
        check_sequences([("s3://b/day", "labels")], here)


# ---- plain folders


def test_the_synthetic_city_is_two_folders_with_roles_and_truth(tmp_path):
    files = write_city(tmp_path, frames=2, size=(16, 24))
    dataset = open_dataset(tmp_path, labels_as="cityscapes-trainids")
    assert dataset.layout == "folders"
    assert roles(dataset) == {"query": "query", "reference": "reference"}
    assert dataset.truth.file == files / "ground_truth.json"
    assert dataset.warnings == []
    by_folders = find_label_files([str(files / "query"), str(files / "reference")])
    assert repr(dataset.files("label")) == repr(by_folders)  # a stamp that is not known is NaN
    assert dataset.labels_as == "cityscapes-trainids"


def test_a_folder_of_frames_is_one_sequence_and_one_of_folders_a_sequence_each(
    tmp_path, monkeypatch
):
    """What lies in folders in a sequence is passed over, as it is when the folder is encoded."""
    names = ("drive10/1.png", "drive9/2.png", "drive9/10.png", "drive9/small/2.png", "notes/1.txt")
    touch(*(tmp_path / name for name in names))
    assert outline(open_dataset(tmp_path)) == {"drive9": ["2", "10"], "drive10": ["1"]}
    assert roles(open_dataset(tmp_path)) == {"drive9": None, "drive10": None}
    monkeypatch.chdir(tmp_path / "drive9")
    for folder in (tmp_path / "drive9", "."):
        assert outline(open_dataset(folder)) == {"drive9": ["2", "10"]}


def test_jpegs_are_images_and_pngs_may_be_either(tmp_path):
    plant(tmp_path, "a/1.jpg", "a/2.png", "a/3.jpg", "a/3.png")
    frames = list(open_dataset(tmp_path).frames)
    names = [[path and path.name for path in (frame.image, frame.label)] for frame in frames]
    assert names == [["1.jpg", None], ["2.png", "2.png"], ["3.jpg", "3.png"]]
    assert set(LABEL_SUFFIXES) < set(IMAGE_SUFFIXES), "on which this rule rests"


def test_images_and_labels_of_separate_folders_are_joined_by_name(tmp_path):
    plant(tmp_path, "monday/images/1.png", "monday/images/2.png")
    touch(tmp_path / "monday/labels/2.png")
    write(tmp_path / "monday/poses.csv", "frame,x,y\n2,5,6\n")
    first, second = open_dataset(tmp_path).frames
    assert (first.image.parent.name, first.label) == ("images", None)
    assert second.label == tmp_path / "monday/labels/2.png"
    assert second.pose[:2] == (5, 6)
    assert outline(open_dataset(tmp_path / "monday")) == {"monday": ["1", "2"]}


@pytest.mark.parametrize("name", ["ground_truth.json", "ground_truth.csv", "ground_truth.npy"])
def test_a_ground_truth_is_found_and_is_no_frame(tmp_path, name):
    touch(tmp_path / "a/1.png", tmp_path / name)
    dataset = open_dataset(tmp_path)
    assert dataset.truth.file == tmp_path / name
    assert outline(dataset) == {"a": ["1"]}
