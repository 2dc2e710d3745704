"""Descriptors stored by hloc, or by `db export`, as a method of `compare`."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refused, refuses

from ssrvlad_torch.baselines import make
from ssrvlad_torch.baselines.stored_descriptors import StoredDescriptors
from ssrvlad_torch.channels.channel import View

h5py = pytest.importorskip("h5py", reason="needs the extra hloc")

CAMVID = ("--labels-as", "camvid-11")
VECTORS = np.random.default_rng(0).random((12, 5))


def write(path: Path, descriptors: dict[str, np.ndarray]) -> Path:
    """As hloc's `extract_features` writes them, in half precision, beside other data sets."""
    with h5py.File(path, "w", libver="latest") as file:
        for name, vector in descriptors.items():
            group = file.create_group(name)
            group.create_dataset("global_descriptor", data=vector.astype("f2"))
            group.create_dataset("image_size", data=[80, 60])
    return path


def hloc(root: Path, vectors: np.ndarray = VECTORS) -> dict[str, np.ndarray]:
    """The names of hloc: paths of images below the folder of all."""
    files = sorted(root.glob("*/images/*.jpg"))
    names = [file.relative_to(root).as_posix() for file in files]
    return dict(zip(names, vectors[: len(names)], strict=True))


def test_a_file_is_a_method_of_compare(compare, two_drives, tmp_path):
    """The descriptors of the queries, times a length, are those of the references."""
    vectors = np.concatenate((7 * VECTORS[:6], VECTORS[:6]))
    file = write(tmp_path / "netvlad.h5", hloc(two_drives, vectors))
    code, rows, err = compare(two_drives, "--method", f"hog,{file}")
    assert (code, err, [*rows]) == (0, [], ["hog", str(file)])
    row = rows[str(file)]
    assert (row["queries"], row["references"], row["recall_at"]["1"]) == (6, 6, 1)
    assert row["bytes_a_reference"] == 5 * 4
    wrong = write(
        tmp_path / "wrong.h5", hloc(two_drives, np.concatenate((vectors[5::-1], vectors[6:])))
    )
    assert compare(two_drives, "--method", wrong)[1][str(wrong)]["recall_at"]["1"] == 0


def test_what_db_export_writes_finds_what_the_method_finds(ssrvlad, two_drives, tmp_path):
    """Frames are named by their ids; nothing but label maps is on disk."""
    for image in two_drives.glob("*/images/*"):
        image.unlink()
    town, file = tmp_path / "town.ssrdb", tmp_path / "town.h5"
    assert ssrvlad("encode", two_drives, "-o", town, "--layout", "auto", *CAMVID)[0] == 0
    assert ssrvlad("db", "export", town, "--format", "hloc", "-o", file)[0] == 0
    names = f"ssr-vlad,{file}"
    options = ("--method", names, "--no-sweep", *CAMVID, "--json")
    code, out, _ = ssrvlad("compare", two_drives, *options)
    rows = json.loads(out)["rows"]
    assert code == 0
    one, other = ([row for row in rows if row["method"] == name] for name in names.split(","))
    assert len(one) == len(other) == 2
    for ours, stored in zip(one, other, strict=True):
        for key in ("recall_at", "auc_pr", "steps"):
            assert ours[key] == stored[key]


def test_frames_that_the_file_lacks_are_named(compare, two_drives, tmp_path):
    incomplete = dict([*hloc(two_drives).items()][2:])
    file = write(tmp_path / "some.h5", incomplete)
    code, rows, _ = compare(two_drives, "--method", f"hog,{file}")
    assert (code, rows["hog"]["queries"]) == (3, 6)
    assert rows[str(file)]["reason"] == (
        f"{file} has no descriptor of 2 of 12 frames: query/000, query/001; "
        "it has query/images/002.jpg, query/images/003.jpg and 8 more"
    )
    missing = str(tmp_path / "missing.h5")
    code, rows, _ = compare(two_drives, "--method", f"hog,{missing}")
    assert code == 3 and "No such file" in rows[missing]["reason"]


@pytest.mark.parametrize(
    ("name", "frame", "path"),
    [
        ("monday/000", "monday/000", None),
        ("db/monday/000.jpg", "monday/000", "/data/db/monday/000.jpg"),
        ("monday/000", "a/000", "/data/monday/000.png"),
        ("000.jpg", "monday/000", "/data/db/monday/000.jpg"),
    ],
)
def test_a_group_is_named_as_the_id_or_as_an_end_of_the_path(name, frame, path, tmp_path):
    others = dict.fromkeys(("x/000", "0", "day/000.jpg"), VECTORS[1])
    method = StoredDescriptors(write(tmp_path / "a.h5", {name: VECTORS[0], **others}))
    method.read({frame: path and Path(path)})
    expected = torch.tensor(VECTORS[0]).half().float()
    got = method.encode_query([View(frame)])
    torch.testing.assert_close(got[0], torch.nn.functional.normalize(expected, dim=0))


def test_the_longest_name_counts_and_one_group_is_one_frame(tmp_path):
    paths = {f"{day}/0": Path(f"/data/{day}/0.jpg") for day in ("monday", "today")}
    names = ("0.jpg", "monday/0.jpg")
    method = StoredDescriptors(write(tmp_path / "a.h5", dict(zip(names, VECTORS, strict=False))))
    method.read(paths)
    both = method.encode_reference([View(frame) for frame in paths])
    assert not torch.equal(both[0], both[1])
    method = StoredDescriptors(write(tmp_path / "b.h5", {"0.jpg": VECTORS[0]}))
    refuses("0.jpg fits monday/0, today/0; expected more of the path", method.read, paths)


def test_other_files_and_damaged_descriptors_are_refused(tmp_path):
    (tmp_path / "a.h5").write_text("no HDF5")
    refuses("a.h5 is no whole HDF5 file: ", make, str(tmp_path / "a.h5"))
    whole = write(tmp_path / "b.h5", dict(zip("ab", VECTORS, strict=False))).read_bytes()
    (tmp_path / "b.h5").write_bytes(whole[: len(whole) // 2])
    refuses("b.h5 is no whole HDF5 file: ", make, str(tmp_path / "b.h5"))
    with h5py.File(tmp_path / "c.hdf5", "w") as file:
        file.create_dataset("global_descriptor", data=[1.0])
    with refused("c.hdf5 has no group with a global_descriptor, as hloc writes them"):
        make(str(tmp_path / "c.hdf5"))
    bad = {"short": VECTORS[1][:3], "nan": VECTORS[1] * np.nan, "wide": VECTORS[:1]}
    for name, vector in bad.items():
        method = make(str(write(tmp_path / "d.h5", {"a": VECTORS[0], name: vector})))
        with refused(rf"d.h5: {name}/global_descriptor must be \(5,\) finite floats, got "):
            method.read({"a": None, name: None})
    with refused("unknown method 'a.npy'; expected one of .*, or a file of stored descriptors"):
        make("a.npy")
