"""Which files are frames, and of which sequence."""

from pathlib import Path

import numpy as np
import pytest
from helpers import refuses, street, touch

from ssrvlad_torch.datasets.frame_files import FrameFile, read_ahead
from ssrvlad_torch.datasets.label_files import find_label_files


def ids(files):
    return [file.frame for file in files]


def test_the_files_of_a_folder_are_a_sequence_in_the_order_of_a_person(tmp_path):
    folder = tmp_path / "monday"
    touch(*(folder / name for name in ("f10.png", "f2.png", "f1.tif", "f3.PNG", "f01.bmp")))
    others = "notes.txt", "more.TXT", "poses", ".hidden.txt", "below/f5.png"
    touch(*(folder / name for name in others))
    (folder / "f6.png").mkdir()
    expected = ["monday/f01", "monday/f1", "monday/f2", "monday/f3", "monday/f10"]
    assert ids(find_label_files([str(folder)])) == expected
    assert ids(find_label_files([f"{folder}/"])) == ids(find_label_files([folder])) == expected
    notes = []
    find_label_files([folder], note=notes.append)
    assert "passed over: 2 .txt, 1 without suffix; label maps are .png, .npy" in notes[0]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (".", "monday/1"),
        ("./", "monday/1"),
        ("1.png", "monday/1"),
        ("*.png", "monday/1"),
        ("../monday", "monday/1"),
        ("..", "maps/2"),
        ("../tuesday/..", "maps/2"),
        ("../tuesday/../monday", "monday/1"),
    ],
)
def test_a_relative_folder_gives_its_real_name(tmp_path, monkeypatch, source, expected):
    maps = tmp_path / "maps"
    touch(maps / "monday" / "1.png", maps / "2.png", maps / "tuesday" / "3.png")
    monkeypatch.chdir(maps / "monday")
    assert ids(find_label_files([source])) == [expected]


def test_a_glob_gives_files_or_the_folders_that_it_matches(tmp_path):
    touch(*(tmp_path / "a" / name for name in ("1.png", "2.png", "2.txt", "x.png")))
    touch(tmp_path / "b" / "1.png", tmp_path / "b" / "c" / "1.png", tmp_path / "ground_truth.json")
    for pattern, expected in {
        "a/[0-9]*": ["a/1", "a/2"],
        "?/1.png": ["a/1", "b/1"],
        "**/1.png": ["a/1", "b/1", "c/1"],
        "**": ["a/1", "a/2", "a/x", "b/1", "c/1"],
        "*": ["a/1", "a/2", "a/x", "b/1"],  # these folders
    }.items():
        assert ids(find_label_files([str(tmp_path / pattern)])) == expected


def test_arrays_in_a_folder_are_frames_of_its_sequence_and_stacks_sequences(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    np.save(folder / "one.npy", street(0))
    np.save(folder / "two.npy", np.stack([street(0)] * 2))
    assert ids(find_label_files([str(folder)])) == ["a/one", "a/two-000000", "a/two-000001"]
    stacks = [str(tmp_path / f"{name}.npy") for name in "xy"]
    for stack in stacks:
        np.save(stack, street(0)[None])
    by_shell = find_label_files(stacks)
    assert find_label_files([str(tmp_path / "*.npy")]) == by_shell
    assert ids(by_shell) == ["x/x-000000", "y/y-000000"]
    (folder / "two.npy").unlink()
    joined = find_label_files([str(folder), stacks[0]], "drive")
    assert ids(joined) == ["drive/one", "drive/x-000000"]


def test_every_and_start_count_in_each_sequence(tmp_path):
    touch(*(tmp_path / name / f"{number}.png" for name in "ab" for number in range(8)))
    sources = [str(tmp_path / name) for name in "ab"]
    files = find_label_files(sources, every=3, start=1)
    assert ids(files) == ["a/1", "a/4", "a/7", "b/1", "b/4", "b/7"]
    assert ids(find_label_files(sources[:1], every=100)) == ["a/0"]


def test_one_frame_of_two_files_is_refused(tmp_path):
    touch(tmp_path / "x" / "a" / "1.png", tmp_path / "y" / "a" / "1.png")
    sources = [str(tmp_path / "x" / "a"), str(tmp_path / "y" / "a")]
    with pytest.raises(ValueError, match=r"frame 'a/1' is both .*x/a/1\.png and .*y/a/1\.png"):
        find_label_files(sources, sequence="a")
    assert ids(find_label_files(sources)) == ["x/a/1", "y/a/1"]
    touch(tmp_path / "x" / "a" / "1.tif")
    refuses("is both", find_label_files, sources[:1])


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("missing", "missing does not exist and matches no file"),
        ("missing/*.png", "does not exist and matches no file"),
        ("empty", r"empty holds no label maps; expected \.png"),
        ("others", "others holds no label maps"),
        ("others/a.txt", "a.txt holds no label maps"),
        ("others/*", "holds no label maps"),
        ("stack", "stack holds no label maps"),
    ],
)
def test_a_source_without_label_maps_is_refused_by_name(tmp_path, source, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "stack").mkdir()
    np.save(tmp_path / "stack" / "none.npy", np.zeros((0, 4, 4), np.uint8))
    touch(tmp_path / "others" / "a.txt", tmp_path / "others" / "b.jpg")
    refuses(message, find_label_files, [str(tmp_path / source)])


def test_a_file_that_cannot_be_read_is_passed_on_with_the_reason_in_its_place():
    files = [FrameFile("a", str(number), Path(f"{number}.png")) for number in range(9)]

    def read(file):
        if file.name == "7":
            raise ValueError("seven")
        if file.name == "8":
            raise MemoryError
        return file.name

    results = read_ahead(read, files, workers=3, ahead=5)
    for file in files[:8]:
        passed, content = next(results)
        assert passed is file and str(content) == ("seven" if file.name == "7" else file.name)
    with pytest.raises(MemoryError):
        next(results)
