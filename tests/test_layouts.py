"""Opening data sets: recognising layouts, and saying what was expected."""

import pytest
from trees import plant, write

from ssrvlad_torch.datasets.layouts import LAYOUTS, open_dataset

SMALLEST = {
    "extended-cmu": "slice7/database/img_00119_c0_1287503873253450us.jpg",
    "robotcar-seasons": "images/dawn/rear/1418721355795420.jpg",
    "synthia": "SYNTHIA-SEQS-04-FALL/RGB/Stereo_Left/Omni_F/000000.png",
    "cityscapes": "leftImg8bit/train/aachen/aachen_000000_000019_leftImg8bit.png",
    "camvid": "701_StillsRaw_full/0001TP_006690.png",
    "vpr-bench": "query/0000000.jpg",
    "folders": "monday/000000.jpg",
}


@pytest.mark.parametrize("name", SMALLEST)
def test_each_layout_is_recognised_by_its_folders_and_by_no_other(tmp_path, name):
    plant(tmp_path, SMALLEST[name], *(["ref/0000000.jpg"] if name == "vpr-bench" else []))
    assert open_dataset(tmp_path).layout == open_dataset(str(tmp_path), name).layout == name
    others = [layout.name for layout in LAYOUTS if layout.recognises(tmp_path)]
    assert set(others) <= {name, "folders"}


def test_every_layout_is_tried_once_and_plain_folders_last():
    names = [layout.name for layout in LAYOUTS]
    assert sorted(names) == sorted(SMALLEST)
    assert names[-1] == "folders"


def test_a_layout_that_does_not_fit_is_refused_with_what_was_wanted_and_found(tmp_path):
    plant(tmp_path, "slice7/images/1.jpg", "slice10/images/1.jpg")
    write(tmp_path / "intrinsics.txt", "")
    with pytest.raises(ValueError, match="is not in the layout extended-cmu") as refusal:
        open_dataset(tmp_path, "extended-cmu")
    assert str(refusal.value) == (
        f"{tmp_path} is not in the layout extended-cmu: expected slice*/database/*.jpg and "
        "slice*/query/*.jpg; found intrinsics.txt, slice7/images, slice10/images; the data set is "
        "at visuallocalization.net/datasets (Extended CMU Seasons, slice*.tar)"
    )


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("extended-cmu", "slice7/database"),
        ("robotcar-seasons", "images/dawn/rear"),
        ("synthia", "SYNTHIA-SEQS-04-FALL/GT/LABELS/Stereo_Left/Omni_F"),
        ("cityscapes", "leftImg8bit/train/aachen"),
        ("camvid", "LabeledApproved_full"),
    ],
)
def test_a_data_set_without_frames_is_refused(tmp_path, name, folder):
    (tmp_path / folder).mkdir(parents=True)
    with pytest.raises(ValueError, match=rf"\({name}\) holds no frames: .* data set is at \w+"):
        open_dataset(tmp_path)


def test_what_no_layout_knows_is_refused_with_all_that_are_known(tmp_path):
    write(tmp_path / "a" / "b" / "c.txt", "")
    with pytest.raises(
        ValueError, match="in no known layout; found a/b; expected one of"
    ) as raised:
        open_dataset(tmp_path)
    assert all(f"{layout.name}: {layout.expected}" in str(raised.value) for layout in LAYOUTS)
    assert "\n" not in str(raised.value)


def test_an_empty_folder_holds_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"folders: expected folders .* found nothing$"):
        open_dataset(tmp_path, "folders")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="found empty/; "):
        open_dataset(tmp_path, "vpr-bench")
