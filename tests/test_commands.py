"""`ssrvlad query`, `locate`, `labels` and `show`."""

import json

import numpy as np
import pytest
from drawings import SPACE, VOID
from helpers import CONFIG, street, write_maps
from loop_streams import objects
from networks import write_graph, write_street
from PIL import Image

from ssrvlad_torch import Database


def test_more_candidates_than_references_give_all_references(ssrvlad, database, maps):
    """What would not fit in memory is never allocated."""
    code, out, _ = ssrvlad("query", database, maps, "--top", 10**12, "--json")
    assert code == 0
    assert {len(json.loads(line)["candidates"]) for line in out.splitlines()} == {6}


def test_the_steps_are_taken_and_reported(ssrvlad, database, maps):
    steps = ("--no-standardise", "--no-sweep", "--follow", "no")
    _, out, err = ssrvlad("query", database, maps, "--top", 1, *steps, "--verbose")
    ends = [line.split()[-4:] for line in out.splitlines()]
    assert ends == [["1.0000", "(cosine,", "confidence", "0.00)"]] * 6
    assert "not standardised, no sweep, followed: no, no temporal sum" in err[-1]
    assert "6 references are too few" in err[-1]
    _, out, err = ssrvlad("query", database, maps, "--top", 1)
    assert out.splitlines()[1] == "monday/001: monday/001 (confidence 0.00)"
    words = "6 answers, too few map frames to say how many are wrong"
    assert err == [f"ssrvlad: {words}. Matched as single frames; details with --verbose"]
    sure = json.loads(ssrvlad("query", database, maps, "--json")[1].splitlines()[0])
    assert sure["confidence"] == 0 and sure["steps"]["standardise"] == {"monday": False}
    lines = ssrvlad("evaluate", database, maps, "--tolerance-frames", 0)[1]
    assert f"Without ground truth: {words}; in truth 0 wrong" in lines
    assert sure["score_is"] == "cosine" and sure["estimate"]["accepted"] == 6
    nothing = ssrvlad("query", database, maps, "--min-confidence", 1)[1].splitlines()
    assert all(": refused (confidence" in line for line in nothing)
    paper = ssrvlad("query", database, maps, "--as-paper", "--verbose")
    assert "temporal sum t = 3" in paper[2][-1]


def test_a_line_of_json_has_the_steps_of_its_sequence_alone(ssrvlad, database, maps, tmp_path):
    tuesday = write_maps(tmp_path / "tuesday", range(3))
    for line in objects(ssrvlad("query", database, maps, tuesday, "--json")[1]):
        for step in ("standardise", "sweep", "follow", "weights"):
            assert [*line["steps"][step]] == [line["query"].split("/")[0]]


def test_as_paper_contradicts_other_options(ssrvlad, refusal, database, maps):
    for option, name in [
        (("--sweep",), "--sweep"),
        (("--follow", "online", "--delay", 2), "--follow and --delay"),
        (("--temporal", 1), "--temporal"),
        (("--channel", "hog"), "--channel"),
    ]:
        line = refusal("query", database, maps, "--as-paper", *option)
        assert line.startswith("ssrvlad: --as-paper means --no-standardise --no-sweep")
        assert line.endswith(f"it contradicts {name}")
    alike = ("--no-sweep", "--follow", "no", "--temporal", 3, "--channel", "ssr-vlad")
    as_paper = ssrvlad("query", database, maps, "--as-paper")
    assert ssrvlad("query", database, maps, "--as-paper", *alike) == as_paper
    assert as_paper[0] == 0


def test_the_folder_of_a_map_that_was_moved_needs_a_sequence_name(ssrvlad, refusal, database, maps):
    (maps.parent / "elsewhere").mkdir()
    moved = maps.rename(maps.parent / "elsewhere" / "monday")
    line = refusal("query", database, moved, "--exclude", 5)
    assert "which is gone: if" in line and "give --sequence monday" in line
    out = ssrvlad("query", database, moved, "--exclude", 5, "--sequence", "monday")[1]
    assert [line.split(": ")[1][:12] for line in out.splitlines()] == ["no candidate"] * 6


def test_help_shows_options_in_groups_and_rare_ones_only_if_asked(ssrvlad):
    few, every = (ssrvlad("query", option)[1] for option in ("--help", "--help-all"))
    headings = ["Arguments:", "Input:", "Answers:", "Matching:", "Options:"]
    assert [line for line in few.splitlines() if line in headings] == headings
    assert "--as-paper" in every and "--as-paper" not in few
    assert ssrvlad("query", "--help")[1] == few, "it was asked once"


@pytest.mark.parametrize("given", [(), ("--min-confidence", 0.1)])
def test_a_query_draws_its_answers_without_ground_truth(ssrvlad, database, maps, given, tmp_path):
    (maps / "poses.csv").write_text("frame,x,y\n" + "".join(f"{n:03d},{n},0\n" for n in range(5)))
    assert ssrvlad("encode", maps, "-o", database, "--labels-as", SPACE)[0] == 0
    picture = tmp_path / "answers.png"
    code, out, _ = ssrvlad("query", database, maps, "--picture", picture, *given)
    assert code == 0 and ("y 0.0 m" in out) == (not given)
    assert Image.open(picture).width > 1000
    refused = ssrvlad("query", database, maps, "--picture", tmp_path / "answers.xyz")
    assert refused[:2] == (2, "") and "a picture is one of" in refused[2][0]


def test_answers_without_a_candidate_are_drawn_too(ssrvlad, database, tmp_path):
    picture, empty = tmp_path / "answers.png", tmp_path / "empty.png"
    for label, code in ((VOID, 0), (77, 2)):  # nothing is seen, and no frame is described
        Image.fromarray(np.full((24, 32), label, np.uint8)).save(empty)
        assert ssrvlad("query", database, empty, "--picture", picture)[0] == code
        assert Image.open(picture).width > 1000


@pytest.fixture
def town(network, ssrvlad, tmp_path):
    """A database of the photos, all but one with a pose."""
    poses = ["frame,x,y,heading", *(f"photos/{seed},{seed},0,0.5" for seed in range(2))]
    (tmp_path / "poses.csv").write_text("\n".join(poses))
    town = tmp_path / "town"
    given = ("--segmenter", network, "--channel", "ssr-vlad")
    ssrvlad("encode", tmp_path / "photos", "-o", town, *given)
    return town


def test_locate_takes_the_network_of_the_database(town, network, ssrvlad, refusal, tmp_path):
    photos = [tmp_path / "photos" / f"{seed}.png" for seed in (1, 2)]
    code, out, _ = ssrvlad("locate", *photos, "--in", town)
    first, second = out.splitlines()
    assert code == 0
    assert first.startswith("photos/1: photos/1 (confidence 0.")
    assert first.endswith(", x 1.0 m, y 0.0 m, heading 29 degrees)")
    assert second.startswith("photos/2: photos/2 (") and " m, " not in second
    found = json.loads(ssrvlad("locate", photos[0], "--in", town, "--json")[1])
    assert (found["picture"], found["place"], found["x"]) == ("photos/1", "photos/1", 1)
    assert found["score_is"] == "cosine" and found["score"] <= 1
    unsure = ssrvlad("locate", photos[0], "--in", town, "--min-confidence", 1)[1]
    assert unsure.startswith("photos/1: refused (confidence 0.")
    network.write_text("network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 2]\n")
    assert "gives other label maps" in refusal("locate", photos[0], "--in", town)


def test_locate_refuses_a_database_of_label_maps_and_a_network_of_code(refusal, database, tmp_path):
    locate = ("locate", tmp_path, "--in", database)
    assert "was not made from pictures; name a --segmenter" in refusal(*locate)
    by_code = Database.create(tmp_path / "code.ssrdb", CONFIG)
    by_code.add_origin(None, "key", "mynets:mine")
    line = refusal("locate", tmp_path, "--in", by_code.path)
    assert line.endswith("was made by code: say --segmenter mynets:mine")


def test_labels_lists_classes_and_features(network, ssrvlad, refusal, tmp_path):
    code, out, _ = ssrvlad("labels", network)
    assert code == 0
    assert "8 of 12 classes have a category" in out
    assert "left out: car, pedestrian, bicyclist, void" in out
    assert "features: none: " in out and "no activation at a stride from 4 to 32" in out
    of_space = json.loads(ssrvlad("labels", SPACE, "--json")[1])
    assert of_space["classes"][3] == {"id": 3, "name": "road", "category": "ground"}
    assert of_space["features"] is None
    write_street(tmp_path / "net.onnx")
    settings = tmp_path / "net.yaml"
    for named, names in (("", ["relu_2", "relu_3"]), ("features: [relu_1]", ["relu_1"])):
        settings.write_text(f"network: net.onnx\nlabels_as: {SPACE}\n{named}")
        assert f"features: {names[0]} (1, " in ssrvlad("labels", settings)[1]
        assert json.loads(ssrvlad("labels", settings, "--json")[1])["features"] == names
    settings.write_text("mean: [0, 0, 0]\nclasses: 0:19\n")
    for given, message in (
        (settings, "net.yaml names no network; expected network: NAME"),
        ("camvid-1", "unknown label space 'camvid-1': did you mean camvid-11"),
        ("net.onxx", "no network 'net.onxx'"),
    ):
        assert message in refusal("labels", given)
    assert ssrvlad("labels", "mapillary-vistas-1.2")[::2] == (0, [])


def test_labels_lists_all_activations(ssrvlad, refusal, tmp_path):
    """Also of a network that has no features by the rule, and of one without class names."""
    write_street(tmp_path / "street.onnx")
    command = ("labels", tmp_path / "street.onnx", "--labels-as", SPACE)
    code, out, err = ssrvlad(*command, "--all")
    assert (code, err) == (0, [])
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines()]
    assert [row for row in rows if "features" in row] == [
        ["relu_2", "32", "28", "56", "8", "features"],
        ["relu_3", "24", "14", "28", "16", "features"],
    ]
    *_, line = out.splitlines()
    assert line == "features: relu_2 (1, 32, 28, 56), stride 8, relu_3 (1, 24, 14, 28), stride 16"
    listed = json.loads(ssrvlad(*command, "--all", "--json")[1])["activations"]
    by_name = {row["name"]: row for row in listed}
    assert by_name["relu_2"]["chosen"] and by_name["relu_2"]["shape"] == [1, 32, 28, 56]
    assert by_name["relu_3"]["stride"] == 16
    assert sum(row["chosen"] for row in listed) == 2
    assert "activations" not in json.loads(ssrvlad(*command, "--json")[1])
    write_graph(tmp_path / "net.onnx")
    out = ssrvlad("labels", tmp_path / "net.onnx", "--labels-as", SPACE, "--all")[1]
    assert "classes" in out and "features: none: " in out
    assert "--labels-as and --all are for networks" in refusal("labels", SPACE, "--all")


def test_show_takes_an_image(network, ssrvlad, tmp_path):
    frame, picture = tmp_path / "photos" / "1.png", tmp_path / "out.png"
    assert ssrvlad("show", frame, "-o", picture, "--segmenter", network)[0] == 0
    shown = Image.open(picture)
    labels = frame.with_name("labels.png")
    Image.fromarray(street(1, 60, 80)).save(labels)
    assert ssrvlad("show", labels, "-o", tmp_path / "map.png", "--labels-as", SPACE)[0] == 0
    assert shown.width == 1.5 * Image.open(tmp_path / "map.png").width, (
        "the photograph is beside it"
    )
    sky = np.array([128, 128, 128])
    assert (np.abs(np.asarray(shown)[..., :3] - sky) < 2).all(-1).any()
    assert len([*(tmp_path / "cache").rglob("*.npz")]) == 1
    assert "--labels-as" in ssrvlad("show", frame, "-o", picture)[2][0]
