"""The layout of VPR-Bench."""

import pytest
from trees import outline, plant, roles
from vpr_bench import CORRIDOR, needs_corridor

from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.datasets.layouts import open_dataset


@pytest.fixture
def tree(tmp_path):
    """As it is unpacked; the text and the second ground truth come with some of the sets."""
    root = plant(
        tmp_path / "datasets" / "corridor",
        *(f"query/{number:07d}.jpg" for number in range(11)),
        *(f"ref/{number:07d}.jpg" for number in range(12)),
    )
    for name in ("ground_truth_new.npy", "ReadMe.txt", "query/Thumbs.db"):
        (root / name).touch()
    return root


def test_queries_references_and_truth(tree):
    dataset = open_dataset(tree)
    assert dataset.layout == "vpr-bench"
    assert roles(dataset) == {"query": "query", "ref": "reference"}
    assert outline(dataset)["query"] == [f"{number:07d}" for number in range(11)]
    assert len(outline(dataset)["ref"]) == 12
    assert dataset.truth.file == tree / "ground_truth_new.npy"
    assert dataset.truth.metres is dataset.truth.frames is dataset.labels_as is None
    assert dataset.warnings == []


def test_numbers_without_zeros_are_sorted_as_numbers(tmp_path):
    """Row 10 of the ground truth is the image 10, not the image that sorts tenth as text."""
    names = [f"{folder}/{n}.jpg" for folder in ("query", "ref") for n in range(12)]
    dataset = open_dataset(plant(tmp_path, *names))
    assert outline(dataset)["ref"] == [str(n) for n in range(12)]


def test_the_ground_truth_may_lie_beside_the_folder(tree, monkeypatch):
    (tree / "ground_truth_new.npy").rename(tree.parent / "corridor.ground_truth_new.npy")
    assert open_dataset(tree).truth.file == tree.parent / "corridor.ground_truth_new.npy"
    monkeypatch.chdir(tree)
    assert open_dataset(".").truth.file == tree.parent / "corridor.ground_truth_new.npy"


def test_a_missing_ground_truth_is_noted(tree):
    (tree / "ground_truth_new.npy").unlink()
    dataset = open_dataset(tree)
    assert dataset.truth is None
    assert dataset.warnings == [
        f"{tree} has no ground_truth_new.npy; it is at github.com/MubarizZaffar/VPR-Bench"
    ]


def test_an_empty_folder_is_refused(tree):
    for image in (tree / "ref").iterdir():
        image.unlink()
    with pytest.raises(ValueError, match=r"corridor/ref holds no images; .*MubarizZaffar"):
        open_dataset(tree)


@needs_corridor
def test_the_corridor():
    dataset = open_dataset(CORRIDOR)
    assert {name: len(frames) for name, frames in outline(dataset).items()} == {
        "query": 111,
        "ref": 111,
    }
    assert dataset.truth.file.name == "corridor.ground_truth_new.npy"
    assert dataset.warnings == []
    first = dataset.select(role="query").image_files()[0]
    assert (first.frame, read_image(first).shape) == ("query/0000000", (120, 160, 3))
