"""Plain folders."""

import pytest
from helpers import touch
from trees import outline, plant, roles, write

from ssrvlad_torch.datasets.label_files import SUFFIXES as LABEL_SUFFIXES
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.datasets.names import IMAGE_SUFFIXES
from ssrvlad_torch.datasets.synthetic_city import write_city


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
