"""Which files are frames, and of which sequence."""

from pathlib import Path

import numpy as np
import pytest
from helpers import street, touch

from ssrvlad_torch.datasets.frame_files import FrameFile, read_ahead
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.taxonomy import label_space


def ids(files):
    return [file.frame for file in files]


def test_the_files_of_a_folder_are_a_sequence_in_the_order_of_a_person(tmp_path):
    folder = tmp_path / "monday"
    touch(*(folder / name for name in ("f10.png", "f2.png", "f1.tif", "f3.PNG", "f01.bmp")))
    touch(folder / "notes.txt", folder / "poses", folder / "below" / "f5.png")
    (folder / "f6.png").mkdir()
    expected = ["monday/f01", "monday/f1", "monday/f2", "monday/f3", "monday/f10"]
    assert ids(find_label_files([str(folder)])) == expected
    assert ids(find_label_files([f"{folder}/"])) == ids(find_label_files([folder])) == expected
    for wrong in (str(folder), folder, []):
        with pytest.raises(ValueError, match="expected a list of folders, files or globs, got "):
            find_label_files(wrong)


def test_hidden_files_and_halves_are_no_frames(tmp_path):
    touch(*(tmp_path / "a" / name for name in ("1.png", "._1.png", ".2.png", ".3.png.part")))
    assert ids(find_label_files([str(tmp_path / "a")])) == ["a/1"]


def test_weird_names_are_kept(tmp_path):
    names = ["C:\\maps\\1.png", "straße 3 🚗.png", "a.b.c.png", "[x]*?.png"]
    touch(*(tmp_path / "[a]" / name for name in names))
    files = find_label_files([str(tmp_path / "[a]")])
    assert {file.name for file in files} == {name.removesuffix(".png") for name in names}


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


def test_a_link_to_a_folder_gives_its_own_name(tmp_path):
    touch(tmp_path / "0001" / "1.png")
    (tmp_path / "monday").symlink_to(tmp_path / "0001")
    assert ids(find_label_files([str(tmp_path / "monday")])) == ["monday/1"]


def test_a_link_to_nothing_is_a_frame_that_is_refused_by_name(tmp_path):
    (tmp_path / "1.png").symlink_to(tmp_path / "gone.png")
    (file,) = find_label_files([str(tmp_path)])
    with pytest.raises(ValueError, match="No such file"):
        read_label_map(file, label_space("camvid-11"))


def test_globs(tmp_path):
    touch(*(tmp_path / "a" / name for name in ("1.png", "2.png", "2.txt", "x.png")))
    touch(tmp_path / "b" / "1.png", tmp_path / "b" / "c" / "1.png")
    find = lambda pattern: ids(find_label_files([str(tmp_path / pattern)]))  # noqa: E731
    assert find("a/[0-9]*") == ["a/1", "a/2"]
    assert find("?/1.png") == ["a/1", "b/1"]
    assert find("**/1.png") == ["a/1", "b/1", "c/1"]
    assert find("**") == ["a/1", "a/2", "a/x", "b/1", "c/1"]


def test_a_glob_of_folders_is_these_folders(tmp_path):
    touch(tmp_path / "a" / "1.png", tmp_path / "b" / "1.png", tmp_path / "b" / "c" / "1.png")
    touch(tmp_path / "ground_truth.json")
    assert ids(find_label_files([str(tmp_path / "*")])) == ["a/1", "b/1"]


def test_a_glob_is_what_a_shell_would_have_made_of_it(tmp_path):
    for name in ("x", "y"):
        np.save(tmp_path / f"{name}.npy", street(0)[None])
    by_shell = find_label_files([str(tmp_path / "x.npy"), str(tmp_path / "y.npy")])
    assert find_label_files([str(tmp_path / "*.npy")]) == by_shell
    assert ids(by_shell) == ["x/x-000000", "y/y-000000"]


def test_arrays_and_stacks_in_a_folder_belong_to_its_sequence(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    np.save(folder / "one.npy", street(0))
    np.save(folder / "two.npy", np.stack([street(0)] * 2))
    assert ids(find_label_files([str(folder)])) == ["a/one", "a/two-000000", "a/two-000001"]


def test_the_sequence_may_be_named(tmp_path):
    touch(tmp_path / "a" / "1.png")
    np.save(tmp_path / "stack.npy", street(0)[None])
    sources = [str(tmp_path / "a"), str(tmp_path / "stack.npy")]
    assert ids(find_label_files(sources, "drive")) == ["drive/1", "drive/stack-000000"]


def test_every_and_start_count_in_each_sequence(tmp_path):
    for name in "ab":
        touch(*(tmp_path / name / f"{number}.png" for number in range(8)))
    sources = [str(tmp_path / name) for name in "ab"]
    files = find_label_files(sources, every=3, start=1)
    assert ids(files) == ["a/1", "a/4", "a/7", "b/1", "b/4", "b/7"]
    assert ids(find_label_files(sources[:1], every=100)) == ["a/0"]


@pytest.mark.parametrize(("every", "start"), [(0, 0), (-1, 0), (1, -1)])
def test_every_and_start_out_of_range(tmp_path, every, start):
    touch(tmp_path / "1.png")
    with pytest.raises(ValueError, match=f"got {every} and {start}"):
        find_label_files([str(tmp_path)], every=every, start=start)


def test_one_file_given_twice_is_one_frame(tmp_path, monkeypatch):
    touch(tmp_path / "a" / "1.png")
    monkeypatch.chdir(tmp_path / "a")
    sources = [".", "../a", "1.png", str(tmp_path / "a" / "*.png")]
    assert ids(find_label_files(sources)) == ["a/1"]


def test_one_frame_of_two_folders_of_one_sequence_is_refused(tmp_path):
    touch(tmp_path / "x" / "a" / "1.png", tmp_path / "y" / "a" / "1.png")
    sources = [str(tmp_path / "x" / "a"), str(tmp_path / "y" / "a")]
    with pytest.raises(ValueError, match=r"frame 'a/1' is both .*x/a/1\.png and .*y/a/1\.png"):
        find_label_files(sources, sequence="a")
    assert ids(find_label_files(sources)) == ["x/a/1", "y/a/1"]


def test_one_frame_of_two_formats_is_refused(tmp_path):
    touch(tmp_path / "1.png", tmp_path / "1.tif")
    with pytest.raises(ValueError, match="is both"):
        find_label_files([str(tmp_path)])


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
    with pytest.raises(ValueError, match=message):
        find_label_files([str(tmp_path / source)])


def test_reading_ahead_keeps_the_order_and_bounds_what_is_in_memory():
    files = [FrameFile("a", str(number), Path(f"{number}.png")) for number in range(50)]
    begun = []

    def begin(file):
        begun.append(int(file.name))
        if file.name == "7":
            raise ValueError("seven")
        return int(file.name)

    for position, (file, content) in enumerate(read_ahead(begin, files, workers=3, ahead=5)):
        assert file is files[position]
        assert max(begun) < position + 5
        assert str(content) == ("seven" if position == 7 else str(position))
    assert position == 49


def test_what_is_no_refusal_ends_the_reading():
    def fail(file):
        raise MemoryError

    with pytest.raises(MemoryError):
        next(read_ahead(fail, [FrameFile("a", "0", Path("0.png"))], workers=1, ahead=2))
