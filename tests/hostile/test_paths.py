"""Names in files lead to no path outside of their folder; only what we wrote is deleted."""

import hashlib
import json
import shutil
from pathlib import Path

import lance
import numpy as np
import onnx
import pytest
from helpers import refuses, write_maps

from ssrvlad_torch import Database, SSRVLADConfig
from ssrvlad_torch.channels import Column
from ssrvlad_torch.database.exporting import export_database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.database.rows import new_schema
from ssrvlad_torch.encoding.source import origin_of
from ssrvlad_torch.files import path_within
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_files import external_files
from ssrvlad_torch.taxonomy import label_space

OUTSIDE = ["../x", "..", "a/../../x", "/etc/passwd", "..\\x", "a\0b", "", 3, None, ["a"]]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_name_that_leaves_its_folder_is_no_path(tmp_path, name):
    refuses("expected the name of a file in", path_within, tmp_path, name)


def test_a_link_is_not_what_we_wrote(tmp_path):
    (tmp_path / "index.json").symlink_to("elsewhere")
    refuses(r"index\.json is a link", path_within, tmp_path, "index.json", r"index\.json")
    assert path_within(tmp_path, "nets/a.onnx") == tmp_path / "nets" / "a.onnx"


FILES = ["thesis.docx", "photo.jpg", "00.backup.tar", "0a1b2c3d/keys.kdbx"]


@pytest.fixture
def home(tmp_path, ssrvlad):
    """A folder with files of the user, and a database with an index in it."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    maps = write_maps(tmp_path / "monday", range(6))
    assert ssrvlad("encode", maps, "-o", tmp_path / "town", "--labels-as", "camvid-11")[0] == 0
    assert ssrvlad("db", "index", tmp_path / "town")[0] == 0
    return tmp_path


def linked(home: Path) -> None:
    """The index is a link to the folder of the user."""
    shutil.rmtree(home / "town" / "_index")
    (home / "town" / "_index").symlink_to(home)


def linked_inside(home: Path) -> None:
    shutil.rmtree(home / "town" / "_index" / "codes")
    (home / "town" / "_index" / "codes").symlink_to(home)


@pytest.mark.parametrize("craft", [linked, linked_inside])
@pytest.mark.parametrize("command", ["encode", "db index", "db compact"])
def test_a_crafted_index_deletes_no_file_of_the_user(home, ssrvlad, craft, command):
    craft(home)
    before = sorted(home.glob("*.*"))
    more = write_maps(home / "tuesday", range(3))
    words = [*command.split(), home / "town"]
    if command == "encode":
        words = ["encode", more, "-o", home / "town", "--labels-as", "camvid-11"]
    ssrvlad(*words)
    assert [(home / name).read_text() for name in FILES] == ["mine"] * len(FILES)
    assert sorted(home.glob("*.*")) == before


def test_a_file_of_the_index_that_is_a_link_is_not_written(home, ssrvlad):
    file = home / "town" / "_index" / "learnt.npz"
    file.unlink()
    file.symlink_to(home / "thesis.docx")
    ssrvlad("db", "index", home / "town")
    assert (home / "thesis.docx").read_text() == "mine"


def test_a_database_of_links_is_refused(home):
    shutil.move(home / "town" / "data", home / "data")
    (home / "town" / "data").symlink_to(home / "data")
    refuses(r"town/data is a link; expected a folder", Database.open, home / "town")


CONFIG = SSRVLADConfig.from_preset("default", labels_as="camvid-11")
COLUMN = Column("ssr-vlad", CONFIG.fingerprint, (CONFIG.length,))
ORIGIN = "origin:0123456789abcdef"
SCHEMA = new_schema(CONFIG, [COLUMN])
KEY, DIGEST = (key.decode() for key in SCHEMA.metadata)


def crafted(folder: Path, change: object) -> Path:
    """A table of Lance whose settings, or entries that begin with "origin:", are changed."""
    entries = {key.decode(): text.decode() for key, text in SCHEMA.metadata.items()}
    content = json.loads(entries[KEY])
    if isinstance(change, dict) and ORIGIN in change:
        entries |= change
    else:
        text = json.dumps({**content, **change}) if isinstance(change, dict) else str(change)
        entries |= {KEY: text, DIGEST: hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}
    table = SCHEMA.with_metadata(entries).empty_table()
    lance.write_dataset(table, folder)
    return folder


COLUMNS = [
    {"name": "other"},
    {"fingerprint": None},
    {"shape": [1 << 70]},
    {"dtype": "object"},
    {"later": 1},
]
FOREIGN = [
    *("{", "[]", "3", "null", '{"format": 5}', "[" * 5000),
    *({"columns": value} for value in (None, {}, [], [1], 3)),
    *({"columns": [{**COLUMN._asdict(), **change}]} for change in COLUMNS),
    *({"config": value} for value in (3, [1], "default", {"later": 1})),
    *({"config": {**CONFIG.to_dict(), "labels_as": name}} for name in ("/etc/passwd", "x.yaml", 3)),
    *({ORIGIN: text} for text in ("{", "[]", "3", "{}", '{"label_space": 3}', "null")),
    {ORIGIN: json.dumps({"label_space": None, "segmenter": [], "network": 3})},
    {ORIGIN: json.dumps({"label_space": None, "later": ""})},
]


@pytest.mark.parametrize("change", FOREIGN, ids=str)
def test_foreign_metadata_of_a_database_are_one_line_that_names_it(tmp_path, refusal, change):
    path = crafted(tmp_path / "town", change)
    assert str(path) in refusal("db", "info", path)


@pytest.mark.parametrize("name", ["net.onnx", "../net.onnx", "/nets/../net.onnx"])
def test_a_network_of_a_database_has_an_absolute_path(tmp_path, name):
    database = Database.create(tmp_path / "town", CONFIG)
    database.add_origin(label_space("camvid-11"), "digest", name)
    refuses("names its network .*, no absolute path", origin_of, database)


@pytest.mark.parametrize("entry", ["network: ../net.onnx", "network: /net.onnx"])
def test_a_network_of_a_yaml_file_is_in_its_folder(tmp_path, entry):
    (tmp_path / "seg.yaml").write_text(entry)
    refuses(r"seg\.yaml: expected the name of a file in", open_network, tmp_path / "seg.yaml")


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"location": "../secret.bin"}, "expected the name of a file in .*secret"),
        ({}, "the weights 'weights' are in a file without a name"),
    ],
)
def test_external_weights_are_in_the_folder_of_their_model(tmp_path, entries, message):
    weights = onnx.numpy_helper.from_array(np.zeros(3, np.float32), "weights")
    weights.ClearField("raw_data")
    weights.data_location = onnx.TensorProto.EXTERNAL
    for key, value in entries.items():
        weights.external_data.add(key=key, value=value)
    node = onnx.helper.make_node("Identity", ["weights"], ["y"])
    output = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [3])
    graph = onnx.helper.make_graph([node], "g", [], [output], [weights])
    (tmp_path / "net.onnx").write_bytes(onnx.helper.make_model(graph).SerializeToString())
    refuses(message, external_files, tmp_path / "net.onnx")


@pytest.mark.parametrize("frame", ["s/a\0b", "//x", "s/../x", "s//x", "a/global_descriptor"])
def test_an_id_that_hdf5_would_change_is_refused(tmp_path, frame):
    database = Database.create(tmp_path / "town", width=3)
    sequence, name = frame.rsplit("/", 1)
    database.append([FrameRecord(sequence, name)], np.ones((1, 3)))
    refuses("HDF5 cannot have a group", export_database, database, "hloc", tmp_path / "out.h5")
