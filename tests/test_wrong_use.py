"""What a user can type wrong: one line on stderr, the exit code 2, and nothing written."""

import io
import shlex

import pytest
from helpers import write_maps, write_photos, write_truth, write_two_drives
from networks import write_settings

from ssrvlad_torch import Database, Map, SSRVLADConfig
from ssrvlad_torch.datasets.synthetic_city import write_city

CAMVID = "--labels-as camvid-11"
NONE = f"-o none {CAMVID}"
EVALUATE = "evaluate town.ssrdb monday"
HOG = "compare town --method hog"


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Label maps ``monday`` and their map ``town.ssrdb``, a map without frames, photos, the drives
    of ``town`` and of ``city`` with its map, and a network."""
    folder = tmp_path_factory.mktemp("world")
    write_two_drives(folder / "town", 6)
    truth = {f"query/{n:03d}": [f"reference/{n:03d}"] for n in range(6)}
    write_truth(folder / "town" / "ground_truth.json", truth)
    write_city(folder / "city", frames=8, seed=1, size=(60, 80))
    maps = write_maps(folder / "monday", range(6)), folder / "city" / "reference"
    for name, labels, labels_as in zip(
        ("town", "city"), maps, ("camvid-11", "cityscapes-trainids"), strict=True
    ):
        Map.open(folder / f"{name}.ssrdb", labels_as=labels_as).add(labels)
    Database.create(folder / "bare.ssrdb", SSRVLADConfig(labels_as="camvid-11"))
    write_photos(folder / "jpegs", range(1), ".jpg")
    write_photos(folder, range(1)).joinpath("000.png").rename(folder / "photo.png")
    write_settings(folder)
    return folder


WRONG_USES = [
    ("fly", "No such command 'fly'"),
    ("verify none.onnx", "ssrvlad: none.onnx does not exist; expected an ONNX graph"),
    ("verify net.onnx --against net.onnx", "net.onnx is an ONNX file; expected the network"),
    ("verify networks:Street --against net.onnx", "is no ONNX file; expected the one"),
    ("verify net.onnx --against x:y --labels maps", "do not go with --against"),
    ("verify net.onnx --against nothing:y", "no network 'nothing:y'"),
    ("fuse none.onnx -o none/p.onnx --labels-as camvid-11", "there is no folder"),
    (f"export {NONE} --size 8", "--size 8: expected rows and columns, such as 512x1024"),
    ("city monday", "monday is not empty; expected a new or an empty folder"),
    ("db compact town.ssrdb --keep-days inf", "--keep-days': Input should be less than or"),
    (f"show photo.png -o x.png {CAMVID}", "is not in label space camvid-11; is this a photo"),
    (f"show monday -o x.png {CAMVID}", "ssrvlad: monday: expected one frame, got 6"),
    # encode
    (f"encode {NONE}", "Missing argument"),
    (f"encode '' {NONE}", "the argument after encode is empty; expected a text"),
    (f"encode monday {NONE} --sequence=", "--sequence is empty; expected a text"),
    ("encode monday -o none", "expected the label space of the label maps, --labels-as"),
    (f"encode none {NONE}", "none does not exist"),
    (f"encode jpegs {NONE}", "jpegs holds images and no label maps; name the network"),
    (f"encode monday {NONE} --start 99", "no sequence has a frame 99; the longest has 6 frames"),
    (f"encode monday {NONE} --segmenter no.onnx", "no.onnx does not exist or is not a file"),
    (f"encode monday {NONE} --segmenter photo.png", "'photo.png'; expected FILE.onnx"),
    (f"encode monday {NONE} --segmenter-cache cache", "--segmenter-cache needs --segmenter"),
    (f"encode monday {NONE} --engine ray --gpus 1", "--gpus needs --engine ray and --segmenter"),
    (f"encode jpegs {NONE} --segmenter net.yaml --gpus 1", "--gpus needs --engine ray and"),
    (f"encode monday {NONE} --prune --topic /left", "--prune needs whole folders as SOURCE, with"),
    # query
    ("query town.ssrdb monday --top 0", "Input should be greater than or equal to 1, got 0"),
    ("query town.ssrdb monday --follow on", "'--follow': 'on' is not one of 'offline'"),
    ("query town.ssrdb monday --min-confidence nan", "'--min-confidence': Input should be less"),
    ("query town.ssrdb monday --max-wrong 0.1 --min-confidence 0.5", "--min-confidence"),
    ("query bare.ssrdb monday", "bare.ssrdb holds no frames yet"),
    (
        "query town.ssrdb -",
        "SOURCE - answers as frames come: expected --follow online, got offline",
    ),
    ("query town.ssrdb - --follow online --temporal 2", "SOURCE - takes no --temporal"),
    ("query town.ssrdb - --follow online --max-wrong 0.1", "SOURCE - takes no --max-wrong"),
    ("query town.ssrdb - --follow online --exclude 2", "SOURCE - takes no --exclude"),
    ("query town.ssrdb - --follow online --every 2", "- takes no other SOURCE, no --layout"),
    ("query none.ssrdb monday --near 1,2", "near: expected X,Y,METRES, three finite numbers"),
    ("query town.ssrdb monday --near 1,2,3", "candidates with poses, town.ssrdb has none"),
    ("query town.ssrdb monday --near -1,2,3", "candidates with poses, town.ssrdb has none"),
    ("query city.ssrdb city/query --near 0,9e3,3", "is within 3 m of 0, 9000; the nearest is"),
    # evaluate
    (EVALUATE, "got 0 of them"),
    (
        f"{EVALUATE} --tolerance-frames 1 --tolerance-metres 5",
        "expected one of --ground-truth, --tolerance-metres and --tolerance-frames, got 2",
    ),
    (f"{EVALUATE} --tolerance-frames 1 --tolerance-degrees 5", "needs --tolerance-metres"),
    (f"{EVALUATE} --max-wrong 0.1 --min-confidence 0.5", "leave out --min-confidence"),
    # a data set
    *(
        (f"{command} city.ssrdb city {options}", message)
        for command in ("query", "evaluate")
        for options, message in (
            ("--layout auto --split nope", "city has no sequence 'nope'; it has query, ref"),
            ("--split query", "--split, --role and --labels need --layout, such as --layout auto"),
            ("--layout synthia", "city is not in the layout synthia: expected"),
            ("--layout kitti", "unknown layout 'kitti'; expected one of extended-cmu"),
            ("--layout auto --role loop", "'loop' is not one of 'reference', 'query'"),
            ("--layout auto --labels nowhere", "label maps in nowhere need a label space"),
        )
    ),
    # loops
    (f"loops - other {CAMVID}", "takes no other SOURCE"),
    (f"loops - --poses p.csv {CAMVID}", "no other SOURCE, no --layout, --poses, --topic"),
    (f"loops - --segmenter-cache x {CAMVID}", "--segmenter-cache needs --segmenter"),
    (f"loops - --threshold nan {CAMVID}", "Invalid value for '--threshold'"),
    (f"loops - --exclude -1 {CAMVID}", "greater than or equal to 0"),
    # compare
    ("compare town", "Missing option '--method'"),
    ("compare none --method hog", "none is no folder"),
    ("compare --method hog --references town/query", "or folders as --references and --queries"),
    (
        "compare --method hog --references town/query --queries a --layout auto",
        "--layout needs the folder of",
    ),
    (
        "compare --method hog --references town/query/images --queries town/reference/images",
        "town/query/images and town/reference/images both have a sequence 'images'; expected",
    ),
    (
        "compare --method hog --references town/reference --references town/query "
        "--queries town/../town/query",
        "both have a sequence 'query'; expected two folders of different names",
    ),
    (f"{HOG} --set rows=3", "--set: expected METHOD.NAME=VALUE for one of hog, got"),
    (f"{HOG} --set cohog.size=3", "for one of hog, got 'cohog.size'"),
    (f"{HOG} --set rows", "--set: expected NAME=VALUE, got 'rows'"),
    (f"{HOG} --set hog.rows=2", "method hog: got an unexpected keyword argument"),
    ("compare town --method ssr-vlad --set ssr-vlad.temporal=many", "take temporal='many'"),
    (f"{HOG} --tolerance-metres 5", "no reference has a pose"),
    ("compare town/query --method hog", "does not say which of query is a reference; name it"),
]


@pytest.mark.parametrize(("line", "message"), WRONG_USES)
def test_wrong_use_is_one_line_and_exit_code_2(refusal, world, monkeypatch, line, message):
    monkeypatch.chdir(world)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO()))
    before = sorted(world.rglob("*"))
    refused = refusal(*shlex.split(line))
    assert refused.startswith("ssrvlad: ") and message in refused
    assert sorted(world.rglob("*")) == before
