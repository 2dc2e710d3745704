"""Label maps that pyarrow reaches: the same rows as from a folder of this machine."""

import os
import sys

import numpy as np
import pytest
import torch
from helpers import refuses, street, write_street
from networks import write_photos, write_settings
from networks import write_street as write_network
from pyarrow.fs import FileSystem, copy_files

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets import frame_file
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import encode_to_database, encode_to_memory

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
BY_LABELS = [LabelShapes(HEAD)], HEAD.label_space


@pytest.fixture
def folder(tmp_path):
    for number in (0, 2, 10):
        write_street(tmp_path / "mon day" / f"{number}.png", number)
    np.save(tmp_path / "mon day" / "11.npy", street(11))
    (tmp_path / "mon day" / "notes.txt").write_text("rain")
    (tmp_path / "mon day" / ".hidden.png").write_text("no frame")
    (tmp_path / "mon day" / "deeper").mkdir()
    return tmp_path / "mon day"


def test_frames_are_those_of_the_same_files_here(folder):
    files = find_label_files([folder.as_uri()])
    assert [file.frame for file in files] == [f"mon day/{n}" for n in (0, 2, 10, 11)]
    chosen = find_label_files([folder.as_uri()], "x", every=2, start=1)
    assert [file.frame for file in chosen] == ["x/2", "x/11"]
    here, _ = encode_to_memory(*BY_LABELS, find_label_files([str(folder)]))
    there, skipped = encode_to_memory(*BY_LABELS, files)
    assert (skipped, there.frames) == ([], here.frames)
    assert torch.equal(there.descriptors, here.descriptors)


def test_no_password_is_taken_from_a_path_or_shown(folder, tmp_path):
    places = [tmp_path / "day1" / "12:30@cam0", tmp_path / "day2" / "12:45@cam0"]
    for place in places:
        write_street(place / "0.png", 0)
    files = find_label_files([f"file://{place}" for place in places])
    assert [file.folder for file in files] == [f"file://{place}" for place in places]
    assert [file.frame for file in files] == ["12:30@cam0/0", "12:45@cam0/0"]
    [file, *_] = find_label_files([f"{folder.as_uri()}?key=secret"])
    assert "secret" not in repr(file)


def test_changed_files_are_encoded_anew_and_missing_ones_skipped(folder, tmp_path):
    database = Database.create(tmp_path / "db", HEAD.config)
    assert encode_to_database(HEAD, find_label_files([folder.as_uri()]), database).encoded == 4
    write_street(folder / "2.png", 99, 30, 40)
    summary = encode_to_database(HEAD, find_label_files([folder.as_uri()]), database)
    assert (summary.anew, summary.already_there) == ({"file changed": 1}, 3)
    write_street(folder / "3.png", 3)
    files = find_label_files([folder.as_uri()])
    (folder / "3.png").unlink()
    [skipped] = encode_to_database(HEAD, files, database).skipped
    assert skipped.reason.startswith(f"{folder.as_uri()}/3.png: ")
    assert "No such file or directory" in skipped.reason


def test_a_uri_without_frames_is_refused(folder, tmp_path):
    deeper = [(folder / "deeper").as_uri()]
    refuses(r"deeper holds no label maps; expected \.png", find_label_files, deeper)
    with pytest.raises(FileNotFoundError, match="none"):
        find_label_files([(tmp_path / "none").as_uri()])
    refuses("ftp", find_label_files, ["ftp://host/monday"])


@pytest.fixture(params=["local", pytest.param("ray", marks=pytest.mark.slow, id="ray")])
def engine(request, bucket):
    """Neither connections nor Ray's workers know the server of an earlier test."""
    frame_file._connected.cache_clear()
    yield request.param
    if ray := sys.modules.get("ray"):
        ray.shutdown()


def test_label_maps_of_a_bucket_are_encoded_into_a_bucket(bucket, ssrvlad, tmp_path, engine):
    """Settings of the environment serve sources and database, here and in workers."""
    for number in range(5):
        write_street(tmp_path / "monday" / f"{number}.png", number)
    files, place = FileSystem.from_uri(f"{bucket}/maps")
    copy_files(str(tmp_path), place, destination_filesystem=files)
    arguments = [f"{bucket}/maps/monday", "-o", f"{bucket}/db", "--labels-as", "camvid-11"]
    code, out, _ = ssrvlad("encode", *arguments, "--engine", engine)
    assert code == 0
    assert out == ("s3://town/db: 5 frames encoded (0 of them empty), 0 already there, 0 skipped\n")
    local, _ = encode_to_memory(*BY_LABELS, find_label_files([str(tmp_path / "monday")]))
    stored = Database.open(f"{bucket}/db").load()
    assert stored.frames == local.frames
    assert torch.equal(stored.descriptors, local.descriptors)
    host = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://")
    user, settings = "nobody:nothing@", f"?scheme=http&endpoint_override={host}"
    arguments[0] = f"s3://{user}town/maps/monday{settings}"  # neither is stored
    assert "5 already there" in ssrvlad("encode", *arguments, "--engine", engine)[1]


def test_pictures_of_a_bucket_give_the_rows_of_local_files(
    bucket, ssrvlad, tmp_path, monkeypatch, engine
):
    """A network labels them; features and HOG are stored as for pictures here."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_photos(tmp_path / "monday", size=(96, 128))
    files, place = FileSystem.from_uri(f"{bucket}/pictures")
    copy_files(str(tmp_path / "monday"), f"{place}/monday", destination_filesystem=files)
    settings = write_settings(tmp_path)
    write_network(tmp_path / "net.onnx")
    network = ("--segmenter", settings, "--labels-as", "camvid-11", "--segmenter-cache")
    here, there = str(tmp_path / "here"), f"{bucket}/there"
    assert ssrvlad("encode", tmp_path / "monday", "-o", here, *network, tmp_path / "a")[0] == 0
    pictures = f"{bucket}/pictures/monday"
    options = ("-o", there, *network, tmp_path / "b", "--engine", engine)
    code, out, _ = ssrvlad("encode", pictures, *options)
    assert code == 0 and "5 frames encoded (0 of them empty)" in out
    expected, stored = Database.open(here).load(), Database.open(there).load()
    assert stored.frames == expected.frames
    assert list(stored.channels) == ["ssr-vlad", "features", "hog"]
    for name, channel in stored.channels.items():
        assert torch.equal(channel, expected.channels[name])
