"""The layouts of data sets: what is found in a small copy of each, and what is said of the rest."""

import math
import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest
from drawings import CAMVID, needs_camvid
from helpers import refused, refuses
from layout_copies import (
    AUTUMN,
    CITIES,
    DRIVES,
    FALL,
    FRONT,
    MAP,
    NIGHT,
    OCTOBER,
    STILLS,
    TIMES,
    camvid,
    camvid_by_drive,
    camvid_in_splits,
    camvid_of_the_tutorial,
    cityscapes,
    extended_cmu,
    image,
    outline,
    plant,
    robotcar,
    roles,
    synthia,
    vpr_bench,
    write,
)

from ssrvlad_torch.datasets.dataset import GroundTruth
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.layouts import layouts, open_dataset
from ssrvlad_torch.datasets.poses import UNKNOWN
from ssrvlad_torch.taxonomy import label_space

BY_DRIVE = {"0001TP": ["006690"], "0016E5": ["000390", "000420"]}
CITY_FRAMES = {city.replace("/", "-"): CITIES[city] for city in sorted(CITIES)}
CMU_FRAMES = {
    "slice6-c0-2011-04-21": [image(7, 0, MAP)],
    "slice6-c1-2010-10-19": [image(8, 1, OCTOBER)],
    "slice7-c0-2011-04-21": [image(n, 0, MAP + n) for n in (99, 100, 101)],
    "slice7-c1-2011-04-21": [image(n, 1, MAP + n) for n in (99, 100, 101)],
    "slice7-c0-2010-10-01": [image(n, 0, AUTUMN + n) for n in (9, 10, 11)],
    "slice7-c0-2010-10-19": [image(5, 0, OCTOBER)],
}
SYNTHIA_FRAMES = {
    f"{FALL}-Stereo_Left-Omni_F": [f"{n:06d}" for n in range(4)],
    f"{FALL}-Stereo_Right-Omni_B": ["000000"],
    f"{NIGHT}-Stereo_Left-Omni_F": [f"{n:06d}" for n in range(3)],
}
ROBOTCAR_FRAMES = {
    "dawn-rear": ["1418721355795420", "1418721356878649"],
    "night-rain-rear": ["1418840450664292"],
    **{f"overcast-reference-{side}": [*map(str, TIMES)] for side in ("left", "rear", "right")},
}
VPR_FRAMES = {"query": [f"{n:07d}" for n in range(11)], "ref": [str(n) for n in range(12)]}
ALONG = GroundTruth(frames=1)
FOUND = [
    (cityscapes, "cityscapes", "cityscapes-ids", None, CITY_FRAMES),
    (camvid, "camvid", "camvid-32", ALONG, DRIVES),
    (camvid_in_splits, "camvid", "camvid-32", ALONG, DRIVES),
    (camvid_of_the_tutorial, "camvid", "camvid-11", ALONG, DRIVES),
    (camvid_by_drive, "camvid", "camvid-11", ALONG, BY_DRIVE),
    (synthia, "synthia", "synthia", GroundTruth(metres=7), SYNTHIA_FRAMES),
    (robotcar, "robotcar-seasons", None, GroundTruth(metres=5), ROBOTCAR_FRAMES),
    (extended_cmu, "extended-cmu", None, GroundTruth(metres=5), CMU_FRAMES),
    (vpr_bench, "vpr-bench", None, GroundTruth(Path("ground_truth_new.json")), VPR_FRAMES),
]
REFERENCES = ("overcast-reference", "2011-04-21", "ref")
"""What names of reference traverses contain."""


@pytest.fixture
def copy(tmp_path, request):
    """The small copy that `request.param` makes."""
    root = tmp_path / "data"
    root.mkdir()
    request.param(root)
    return root


def of(*makers):
    return pytest.mark.parametrize("copy", makers, indirect=True)


@pytest.mark.parametrize(("copy", "layout", "space", "truth", "frames"), FOUND, indirect=["copy"])
def test_each_layout_has_its_traverses_label_space_and_truth(copy, layout, space, truth, frames):
    """It is recognised by its folders, and by no other but plain folders, which come last."""
    dataset = open_dataset(copy)
    others = {other.name for other in layouts() if other.recognises(copy)}
    assert others <= {layout, "folders"} and open_dataset(str(copy), layout).layout == layout
    assert (dataset.layout, dataset.labels_as) == (layout, space)
    assert outline(dataset) == frames
    declared = layout in ("robotcar-seasons", "extended-cmu", "vpr-bench")
    assert roles(dataset) == {
        name: ("reference" if any(map(name.count, REFERENCES)) else "query") if declared else None
        for name in frames
    }
    if truth and truth.file:
        truth = GroundTruth(copy / truth.file)
    assert dataset.truth == truth


FRANKFURT, THIRD = "val-frankfurt/frankfurt_000000_000294", f"{NIGHT}-Stereo_Left-Omni_F/000002"
LEFT = "leftImg8bit/val/frankfurt/{}_leftImg8bit.png"
IDS = "gtFine/val/frankfurt/{}_gtFine_labelIds.png"
FILES = [
    (cityscapes, FRANKFURT, LEFT, IDS),
    (camvid_of_the_tutorial, "0001TP/0001TP_008550", "test/{}.png", "testannot/{}.png"),
    (synthia, THIRD, f"{NIGHT}/RGB/{FRONT}/{{}}.png", f"{NIGHT}/GT/LABELS/{FRONT}/{{}}.png"),
]


@pytest.mark.parametrize(("copy", "frame", "image", "label"), FILES, indirect=["copy"])
def test_a_frame_has_its_image_and_its_label_map(copy, frame, image, label):
    [entry] = (entry for entry in open_dataset(copy).frames if entry.frame == frame)
    paths = [copy / path.format(entry.name) for path in (image, label)]
    assert [entry.image, entry.label] == paths


POSES = {
    synthia: {THIRD: (4, 10, math.pi / 2)},
    robotcar: {  # x of a `Pose` is the world's second axis: east, if its first is north
        f"overcast-reference-rear/{TIMES[0]}": (20, 100, math.pi / 2),
        "dawn-rear/1418721355795420": (21, 103, math.pi / 2),
        "dawn-rear/1418721356878649": UNKNOWN,
    },
    extended_cmu: {
        f"slice7-c1-2011-04-21/{image(100, 1, MAP + 100)}": (3, 6, 0),
        f"slice7-c0-2010-10-01/{image(9, 0, AUTUMN + 9)}": (7, 8, 0),
        f"slice7-c0-2010-10-01/{image(10, 0, AUTUMN + 10)}": UNKNOWN,
    },
}


@pytest.mark.parametrize(("copy", "poses"), POSES.items(), indirect=["copy"])
def test_poses_are_joined_by_name(copy, poses):
    stored = {frame.frame: frame.pose for frame in open_dataset(copy).frames}
    for frame, pose in poses.items():
        assert stored[frame] == pytest.approx(pose, abs=1e-12, nan_ok=True)


POSELESS = "no frame of {} has a pose; expected "


def lacking(count, total, kind, first):
    return f"{count} of {total} frames have no {kind}, the first is {first}"


MISSING = [
    (
        cityscapes,
        ["vehicle/val/frankfurt/*294*", "leftImg8bit/test/berlin/*"],
        [
            lacking(1, 6, "image", "test-berlin/berlin_000000_000019"),
            lacking(1, 6, "pose", FRANKFURT),
        ],
    ),
    (
        cityscapes,
        ["vehicle"],
        [f"{POSELESS}vehicle/, which is vehicle_trainvaltest.zip at cityscapes-dataset.com"],
    ),
    (
        synthia,
        [NIGHT, f"{FALL}/GT", f"{FALL}/CameraParams"],
        [f"{POSELESS}SYNTHIA-SEQS-*/CameraParams of the same packages"],
    ),
    (robotcar, [], [lacking(5, 9, "pose", "dawn-rear/1418721356878649")]),
    (extended_cmu, [], [lacking(4, 12, "pose", f"slice6-c0-2011-04-21/{image(7, 0, MAP)}")]),
]


@pytest.mark.parametrize(("copy", "gone", "warnings"), MISSING, indirect=["copy"])
def test_missing_parts_of_a_data_set_are_warnings(copy, gone, warnings):
    for path in [path for pattern in gone for path in copy.glob(pattern)]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert open_dataset(copy).warnings == [warning.format(copy) for warning in warnings]


@pytest.mark.parametrize(
    ("copy", "folder", "below"),
    [
        (camvid_by_drive, "0016E5", "images"),
        (synthia, FALL, "RGB"),
        (extended_cmu, "slice7", "database"),
    ],
    indirect=["copy"],
)
def test_a_folder_of_a_data_set_is_a_data_set(copy, folder, below, monkeypatch):
    names = [name for name in outline(open_dataset(copy)) if name.startswith(folder)]
    assert list(outline(open_dataset(copy / folder))) == names
    monkeypatch.chdir(copy / folder / below)
    assert list(outline(open_dataset(".."))) == names


def test_a_layout_that_does_not_fit_is_refused_with_what_was_wanted_and_found(tmp_path):
    plant(tmp_path, "slice7/images/1.jpg", "slice10/images/1.jpg")
    write(tmp_path / "intrinsics.txt", "")
    with refused("is not in the layout extended-cmu") as refusal:
        open_dataset(tmp_path, "extended-cmu")
    assert str(refusal.value) == (
        f"{tmp_path} is not in the layout extended-cmu: expected slice*/database/img_<number>_c"
        "<camera>_<microseconds>us.jpg and slice*/query/*.jpg; found intrinsics.txt, "
        "slice7/images, slice10/images; the data set is at visuallocalization.net/datasets "
        "(Extended CMU Seasons, slice*.tar)"
    )
    for name in ("dawn.zip", "rain.zip"):
        write(tmp_path / "images" / name, "")
    zips = r"unpacked; found .*images/dawn\.zip, images/rain\.zip"
    refuses(zips, open_dataset, tmp_path, "robotcar-seasons")


def test_an_unknown_layout_is_refused_with_all_known_ones(tmp_path):
    refuses(r"folders: expected folders .* found nothing$", open_dataset, tmp_path, "folders")
    (tmp_path / "empty").mkdir()
    refuses("found empty/; ", open_dataset, tmp_path, "vpr-bench")
    write(tmp_path / "a" / "b" / "c.txt", "")
    expected = [f"{layout.name}: {layout.expected}" for layout in layouts()]
    with refused("in no known layout; found a/b, empty/; expected one of", *expected):
        open_dataset(tmp_path)


@of(cityscapes)
def test_train_ids_are_read_when_asked_for_or_alone(copy):
    name = CITIES["train/aachen"][0]
    plant(copy, f"gtFine/train/aachen/{name}_gtFine_labelTrainIds.png")
    assert open_dataset(copy).labels_as == "cityscapes-ids"
    asked = open_dataset(copy, labels_as="cityscapes-trainids")
    space = label_space("cityscapes-trainids")
    assert open_dataset(copy, labels_as=space).frames == asked.frames
    assert [file.path.name for file in asked.files("label")] == [f"{name}_gtFine_labelTrainIds.png"]
    for path in copy.rglob("*_labelIds.png"):
        path.unlink()
    alone = open_dataset(copy)
    assert alone.labels_as == "cityscapes-trainids"
    assert alone.warnings == [
        "5 of 6 frames have no label map, the first is test-berlin/berlin_000000_000019"
    ]


@of(camvid_of_the_tutorial)
def test_label_maps_of_the_space_that_is_named_are_read(copy):
    """Of two, or of one that is not there: then none."""
    refuses("has no label maps", open_dataset(copy, labels_as="camvid-32").files, "label")
    camvid(copy)
    for space, suffix in (("camvid-11", ""), ("camvid-32", "_L")):
        stems = {f.path.stem for f in open_dataset(copy, labels_as=space).files("label")}
        assert stems == {f"{name}{suffix}" for name in STILLS}


@needs_camvid
def test_the_drives_of_camvid_are_recognised_with_labels_of_networks():
    dataset = open_dataset(CAMVID)
    counts = {name: len(frames) for name, frames in outline(dataset).items()}
    assert counts == {"0001TP": 124, "0016E5": 305}
    assert dataset.warnings == []
    by_hand = [
        replace(file, is_named=False)
        for drive in counts
        for file in find_label_files([str(CAMVID / drive / "labels")], drive, 2, 1)
    ]
    assert repr(dataset.files("label", 2, 1)) == repr(by_hand)  # NaN where a stamp is not known
    for network in ("predicted_dicenet", "predicted_espnetv2"):
        predicted = open_dataset(CAMVID, labels=network, labels_as="cityscapes-trainids")
        assert predicted.warnings == []
        first = predicted.files("label")[0]
        assert first.path.parent.name == network
        assert read_label_map(first, label_space("cityscapes-trainids")).max() < 19


@pytest.mark.parametrize("zone", ["America/Los_Angeles", "Asia/Tokyo"])
@of(extended_cmu)
def test_the_day_of_a_traverse_does_not_depend_on_the_time_zone(copy, monkeypatch, zone):
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        assert list(outline(open_dataset(copy))) == list(CMU_FRAMES)
    finally:
        monkeypatch.undo()
        time.tzset()
