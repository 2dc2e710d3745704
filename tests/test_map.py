"""Known places: drives in, places of pictures and of drives out."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from drawings import SPACE
from helpers import refuses, street, write_maps
from networks import PLAIN, Street, Strided, counted, photo, write_photos, write_settings
from PIL import Image
from torch import nn

from ssrvlad_torch import Map, Segmenter
from ssrvlad_torch.datasets.image_files import pixels_of
from ssrvlad_torch.encoding.results import EncodeOptions
from ssrvlad_torch.recognition.recognise import AS_PAPER


@pytest.fixture
def settings(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return write_settings(tmp_path, f"labels_as: {SPACE}\n")


@pytest.fixture
def photos(tmp_path):
    """Thirty photos, half of them with a pose."""
    write_photos(tmp_path / "monday", range(30), (60, 80))
    rows = [f"monday/{seed},{seed},{-seed},0.5" for seed in range(15)]
    (tmp_path / "poses.csv").write_text("\n".join(["frame,x,y,heading", *rows]))
    return tmp_path / "monday"


@pytest.fixture
def town(settings, tmp_path):
    """A map by a network, not made yet."""
    return Map.open(tmp_path / "town.ssrdb", network=settings)


def test_a_picture_finds_its_place(town, photos):
    """As an array, an image of Pillow, a path, or several of these."""
    assert len(town) == 0 and repr(town).endswith("town.ssrdb: 0 frames>")
    assert town.add(photos).encoded == len(town) == 30
    answer = town.locate(photos / "7.png")
    place = answer.candidates[0]
    assert (place.frame, tuple(place.pose)) == ("monday/7", (7, -7, 0.5))
    assert len(answer.candidates) == 5
    assert 0.5 < answer.confidence <= 1 and answer.score_is == "fused score"
    pixels = photo(street(22, 60, 80))
    several = [pixels, Image.fromarray(pixels), str(photos / "22.png"), photos / "7.png"]
    answers = Map.open(town.path).locate(several, top=2)
    assert [len(answer.candidates) for answer in answers] == [2] * 4
    assert [answer.candidates[0].frame for answer in answers] == ["monday/22"] * 3 + ["monday/7"]
    assert (
        len({tuple((c.frame, c.score) for c in answer.candidates) for answer in answers[:3]}) == 1
    )
    assert all(map(math.isnan, answers[0].candidates[0].pose))
    assert max(answer.candidates[0].score for answer in answers) <= 1
    assert answers[3].candidates[0] == answer.candidates[0]
    near = town.locate(several, near=(3, -3, 2))
    found = {candidate.frame for each in near for candidate in each.candidates}
    assert found == {"monday/2", "monday/3", "monday/4"}
    assert town.locate([]) == []
    town.database.remove(["monday/7"])
    assert town.locate(photos / "7.png").candidates[0].frame != "monday/7"


def test_a_picture_without_layers_has_no_place(settings, photos, tmp_path):
    town = Map.open(tmp_path / "town.ssrdb", settings, preset="paper")
    town.add([photos / "1.png", photos / "2.png"])
    cars = photo(np.full((60, 80), 8))
    nowhere, somewhere = town.locate([cars, photos / "1.png"])
    assert (nowhere.candidates, nowhere.confidence) == ([], 0)
    assert somewhere.candidates[0].frame == "monday/1"
    assert somewhere.confidence == 0, "two frames are nothing to go by"


def test_a_drive_is_found_from_a_folder_files_or_a_database(drawn, tmp_path):
    today = write_maps(tmp_path / "today", range(2, 6))
    Map.open(tmp_path / "other.ssrdb", labels_as=SPACE).add(today)
    for frames in (today, [today], sorted(today.glob("*.png")), tmp_path / "other.ssrdb"):
        answers = drawn.query(frames, top=2)
        assert len(answers) == 4
        assert [answer.query for answer in answers] == [f"today/{n:03d}" for n in range(2, 6)]
        assert [answer.candidates[0].frame for answer in answers] == [
            f"monday/{n:03d}" for n in range(2, 6)
        ]
        assert {len(answer.candidates) for answer in answers} == {2}
        assert repr(answers) == "<Answers: 4 queries, 4 accepted>"
        assert answers._repr_html_().count("<tr>") >= 4
    [first, *_] = drawn.query(today, AS_PAPER, top=1, temporal=1)
    assert first.score_is == "cosine"
    [none, *_] = drawn.query(today, min_confidence=0.5)
    assert none.candidates == [] and none.confidence == 0


def test_pictures_in_memory_are_a_sequence(town, photos):
    town.add(photos)
    pictures = [pixels_of(photos / f"{number}.png") for number in range(12)]
    frames = [f"monday/{number}" for number in range(12)]
    for follow in ("offline", "online", "no"):
        answers = town.query([*pictures[:11], Image.fromarray(pictures[11])], follow=follow)
        assert [answer.query for answer in answers][:2] == ["query/000000", "query/000001"]
        assert [answer.candidates[0].frame for answer in answers] == frames
        assert answers.recognised.used["follow"]["query"].startswith((follow, "no"))
    refuses("expected pictures .*, got .60, 80.", town.query, [street(7, 60, 80)])


def test_label_maps_in_memory_are_a_sequence(drawn, maps):
    labels = [np.asarray(Image.open(file)) for file in sorted(maps.glob("*.png"))]
    found = [answer.candidates[0].frame for answer in drawn.query(labels)]
    assert found == [f"monday/{number:03d}" for number in range(6)]
    refuses("expected folders, globs or files", drawn.query, [labels[0], "monday"])


def test_evaluate_measures_recall_by_a_tolerance(drawn, tmp_path):
    today = write_maps(tmp_path / "today", range(6))
    notes = []
    found = drawn.evaluate(today, tolerance_frames=1, note=notes.append)
    assert found.metrics["recall_at"]["1"] == 1
    assert (found.metrics["queries"], found.metrics["references"]) == (6, 6)
    assert found.metrics["fingerprint"] == drawn.database.fingerprint
    assert found.true_matches == "at most 1 frame away"
    assert [rows.tolist() for rows in found.truth][:2] == [[0, 1], [0, 1, 2]]
    assert notes == []
    refuses("pose", drawn.evaluate, today, tolerance_metres=5.0)


def test_a_network_runs_once_for_each_picture(tmp_path):
    photos = write_photos(tmp_path / "monday", range(6), (96, 128))
    network = counted(Street())
    town = Map.open(tmp_path / "town.ssrdb", Segmenter(network, SPACE, PLAIN))
    town.add(photos)
    assert [column.name for column in town.database.columns] == ["ssr-vlad", "features", "hog"]
    town.locate(photos / "3.png")
    before = int(network.images)
    answers = town.locate([photos / "4.png", photos / "5.png"])
    assert [answer.candidates[0].frame for answer in answers] == ["monday/4", "monday/5"]
    assert int(network.images) == before + 2


def test_pictures_in_memory_are_for_locate(town, photos):
    picture = pixels_of(photos / "7.png")
    for given in ([picture], picture):
        refuses("a list of them, got ndarray; query and locate take pictures", town.add, given)
    refuses("got Image; query and locate take pictures", town.add, Image.fromarray(picture))
    town.add(photos)
    assert town.locate(picture).candidates[0].frame.endswith("/7")


def test_a_map_is_made_by_its_first_frames(settings, photos, maps, tmp_path):
    """A failing `add` leaves nothing behind."""
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "1.jpg").write_bytes(b"torn")
    town = Map.open(tmp_path / "town.ssrdb", settings)
    assert not Path(town.path).exists()
    assert [frame.frame for frame in town.add(tmp_path / "torn").skipped] == ["torn/1"]
    assert not Path(town.path).exists() and len(town) == 0

    def fail(_frames):
        raise KeyboardInterrupt

    refuses("nowhere does not exist", town.add, tmp_path / "nowhere")
    for channels, message in (
        (["x"], "expected a channel, ssr-vlad, features, hog, got 'x'"),
        ("hog", "expected a list of channels, got the text"),
    ):
        refuses(message, Map.open(town.path, settings, channels=channels).add, photos)
    labelled = Map.open(town.path, labels_as=SPACE, channels="hog")
    refuses("expected a list of channels, got the text 'hog'", labelled.add, maps)
    with pytest.raises(KeyboardInterrupt):
        town.add(tmp_path / "torn", EncodeOptions(skipped=fail))
    assert not Path(town.path).exists() and len(town) == 0
    assert town.add(photos).encoded == len(town) == len(Map.open(town.path)) == 30
    assert town.add(photos).already_there == 30


def test_gpus_without_ray_are_refused(town, photos):
    refuses("--gpus needs --engine ray and --segmenter", town.add, photos, EncodeOptions(gpus=1))


def test_channels_of_a_new_map_are_chosen(settings, photos, tmp_path):
    for chosen, stored in (
        (None, ("ssr-vlad", "hog")),
        (["hog"], ("ssr-vlad", "hog")),
        (["ssr-vlad"], ("ssr-vlad",)),
    ):
        town = Map.open(tmp_path / f"{chosen}.ssrdb", settings, channels=chosen)
        town.add(photos)
        assert tuple(column.name for column in town.database.columns) == stored
        kind = "cosine" if stored == ("ssr-vlad",) else "fused score"
        assert town.locate(photos / "3.png").score_is == kind


def test_an_older_version_is_read_only(drawn, maps, tmp_path):
    version = drawn.database.version
    drawn.add(write_maps(tmp_path / "tuesday", range(6)))
    older = Map.open(drawn.path, labels_as=SPACE, version=version)
    assert (len(older), len(drawn)) == (6, 12)
    assert {answer.candidates[0].frame.split("/")[0] for answer in older.query(maps)} == {"monday"}
    refuses("read-only", older.add, write_maps(tmp_path / "wednesday", range(6)))


def test_a_map_that_exists_has_the_preset_and_the_channels_that_are_named(drawn):
    assert len(Map.open(drawn.path, preset="default", channels=["ssr-vlad"])) == len(drawn)
    refuses("has fingerprint .*these settings", Map.open, drawn.path, preset="paper")
    refuses("bogus", Map.open, drawn.path, preset="bogus")
    refuses("holds ssr-vlad of every frame, not hog", Map.open, drawn.path, channels=["hog"])


def test_another_network_is_refused_and_label_maps_are_not(town, drawn, photos, tmp_path):
    town.add(photos)
    other = Segmenter(Strided(2), SPACE, PLAIN)
    message = r"made by .*net\.yaml as it was then; the given network"
    refuses(message, Map.open(town.path, other).locate, photos / "3.png")
    assert Map.open(drawn.path, other).locate(photos / "3.png").candidates
    refuses("was not made from pictures", drawn.locate, photos / "3.png")


def test_a_map_that_another_network_encoded_anew_is_of_that_network(town, settings, photos):
    town.add(photos)
    other = settings.with_name("other.yaml")
    other.write_text(settings.read_text().replace("std: [1, 1, 1]", "std: [2, 2, 2]"))
    assert Map.open(town.path, other).add(photos).anew == {"segmenter changed": 30}
    for network in (other, None):
        answer = Map.open(town.path, network).locate(photos / "7.png")
        assert answer.candidates[0].frame == "monday/7"


def test_other_objects_and_torn_files_are_refused_as_pictures(town, photos):
    refuses(r"town\.ssrdb does not exist", town.locate, photos / "7.png")
    town.add(photos / "1.png")
    torn = photos.parent / "torn.jpg"
    torn.write_bytes(b"torn")
    for picture, message in (
        (np.zeros((3, 4)), r"expected .*\(H, W, 3\) uint8.*, got \(3, 4\) float64"),
        (np.zeros((3, 4, 3)), r"expected .*\(H, W, 3\) uint8.*, got \(3, 4, 3\) float64"),
        (7, r"expected a picture as an \(H, W, 3\) uint8 array, .*, got int"),
        ([photos / "1.png", None], "expected a picture as .*, got NoneType"),
        (torn, r"torn\.jpg: is no image file"),
    ):
        refuses(message, town.locate, picture)
    with pytest.raises(FileNotFoundError, match=r"No such file or directory: '.*none\.png'"):
        town.locate(photos / "none.png")


REFUSED = [
    (lambda town, today: Map.open(3), "expected the folder or URI of a map, got 3"),
    (lambda town, today: Map.open("x", 7), "its name, its file or a Segmenter, got int"),
    (lambda town, today: Map.open("x", nn.Identity()), "or a Segmenter, got Identity"),
    (lambda town, today: Map.open(nn.Identity(), "x"), "expected the folder or URI of a map"),
    (lambda town, today: town.query(today, top=0), "top must be an integer from 1, got 0"),
    (lambda town, today: town.locate(today / "000.png", top=0), "top must be an integer from 1"),
    (lambda town, today: town.query(today, "online"), "expected steps as Steps, got 'online'"),
    (lambda town, today: town.query(today, channels="hog"), "expected a list of channels"),
    (lambda town, today: town.query(today, channels=["hog"]), "holds ssr-vlad of every frame, not"),
    (lambda town, today: town.query(today, min_confidence=0.5, max_wrong=0.1), "no min_confidence"),
    (lambda town, today: town.query(today, min_confidence=90), "min_confidence: expected a"),
    (lambda town, today: town.query(today, max_wrong=5), "max_wrong: expected a fraction"),
    (lambda town, today: town.query(today, single=True, follow="online"), "no steps and no follow"),
    (lambda town, today: town.add(today, engine="rya"), "engine: expected local or ray, got 'rya'"),
]


@pytest.mark.parametrize("call, message", REFUSED, ids=[message for _, message in REFUSED])
def test_wrong_use_is_one_line(drawn, tmp_path, call, message):
    today = write_maps(tmp_path / "today", range(2))
    refuses(re.escape(message), call, drawn, today)
