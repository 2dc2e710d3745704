"""The layouts of CamVid."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CAMVID, needs_camvid
from helpers import write_street
from PIL import Image
from trees import outline, plant

from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.taxonomy import colourise, label_space

NAMES = ("0001TP_006690", "0001TP_008550", "0006R0_f00930", "0016E5_07959", "Seq05VD_f00000")


@pytest.fixture
def original(tmp_path):
    """The two archives of Cambridge, unpacked side by side, and the list of colours."""
    root = plant(tmp_path / "CamVid", *(f"701_StillsRaw_full/{name}.png" for name in NAMES))
    labels = np.arange(32 * 4).reshape(8, 16) // 4
    for name in NAMES:
        path = root / "LabeledApproved_full" / f"{name}_L.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(colourise(labels, "camvid-32")).save(path)
    (root / "label_colors.txt").touch()
    return root


@pytest.fixture
def tutorial(tmp_path):
    """The SegNet tutorial: the first drive is in two splits."""
    root = tmp_path / "CamVid"
    for split, names in (("train", (0, 2)), ("val", (3,)), ("test", (1, 4))):
        for number in names:
            plant(root, f"{split}/{NAMES[number]}.png")
            write_street(root / f"{split}annot" / f"{NAMES[number]}.png", number)
        (root / f"{split}.txt").touch()
    return root


DRIVES = {
    "0001TP": ["0001TP_006690", "0001TP_008550"],
    "0006R0": ["0006R0_f00930"],
    "0016E5": ["0016E5_07959"],
    "Seq05VD": ["Seq05VD_f00000"],
}


def test_the_original(original):
    dataset = open_dataset(original)
    assert (dataset.layout, dataset.labels_as) == ("camvid", "camvid-32")
    assert outline(dataset) == DRIVES
    assert dataset.truth.frames == 1
    assert dataset.warnings == []
    labels = read_label_map(dataset.label_files()[0], label_space("camvid-32"))
    np.testing.assert_array_equal(np.unique(labels), np.arange(32))


def test_the_tutorial_with_drives_put_together_again(tutorial):
    dataset = open_dataset(tutorial)
    assert (dataset.layout, dataset.labels_as) == ("camvid", "camvid-11")
    assert outline(dataset) == DRIVES
    frames = {frame.frame: frame for frame in dataset.frames}
    later = frames["0001TP/0001TP_008550"]
    assert later.image == tutorial / "test" / "0001TP_008550.png"
    assert later.label == tutorial / "testannot" / "0001TP_008550.png"


def test_splits_with_colours(original, tmp_path):
    root = tmp_path / "splits"
    root.mkdir()
    (original / "701_StillsRaw_full").rename(root / "train")
    (original / "LabeledApproved_full").rename(root / "train_labels")
    dataset = open_dataset(root)
    assert (dataset.labels_as, outline(dataset)) == ("camvid-32", DRIVES)


@pytest.fixture
def drives(tmp_path):
    for name in ("0016E5/{}/000390.{}", "0016E5/{}/000420.{}", "0001TP/{}/006690.{}"):
        plant(tmp_path, name.format("images", "jpg"))
        write_street(tmp_path / name.format("labels", "png"), 0)
        write_street(tmp_path / name.format("predicted_net", "png"), 1)
    return tmp_path


def test_a_folder_a_drive(drives):
    dataset = open_dataset(drives)
    assert (dataset.layout, dataset.labels_as) == ("camvid", "camvid-11")
    assert outline(dataset) == {"0001TP": ["006690"], "0016E5": ["000390", "000420"]}
    assert outline(open_dataset(drives / "0016E5")) == {"0016E5": ["000390", "000420"]}


def test_labels_of_another_space_are_taken_at_the_users_word(tutorial):
    assert open_dataset(tutorial, labels_as="my.yaml").labels_as == "my.yaml"


def test_two_label_spaces_in_one_folder_are_refused(original, tutorial):
    with pytest.raises(ValueError, match="label maps of camvid-11 and camvid-32; expected one"):
        open_dataset(tutorial)


def test_drives_of_ones_own_are_not_taken_for_camvid(tmp_path):
    """Their labels could mean anything."""
    plant(tmp_path, "monday/images/1.jpg")
    write_street(tmp_path / "monday/labels/1.png", 0)
    dataset = open_dataset(tmp_path)
    assert (dataset.layout, dataset.labels_as) == ("folders", None)


def test_names_without_a_drive_are_a_traverse_of_their_folder(tutorial):
    plant(tutorial, "train/mine.png")
    assert outline(open_dataset(tutorial))["train"] == ["mine"]


@needs_camvid
def test_the_shared_drives():
    dataset = open_dataset(CAMVID)
    assert {name: len(frames) for name, frames in outline(dataset).items()} == {
        "0001TP": 124,
        "0016E5": 305,
    }
    assert dataset.warnings == []
    folders = [str(CAMVID / drive / "labels") for drive in ("0001TP", "0016E5")]
    by_hand = [
        replace(file, named=False)
        for drive, folder in zip(("0001TP", "0016E5"), folders, strict=True)
        for file in find_label_files([folder], drive, 2, 1)
    ]
    assert repr(dataset.label_files(2, 1)) == repr(by_hand)  # NaN where a stamp is not known
    for network in ("predicted_dicenet", "predicted_espnetv2"):
        predicted = open_dataset(CAMVID, labels=network, labels_as="cityscapes-trainids")
        assert predicted.warnings == []
        first = predicted.label_files()[0]
        assert first.path.parent.name == network
        assert read_label_map(first, label_space("cityscapes-trainids")).max() < 19
