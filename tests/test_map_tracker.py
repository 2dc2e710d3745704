"""`Map.tracker` and `ssrvlad query DB -`: pictures and label maps, frame by frame."""

import io
import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from drawings import SPACE
from helpers import Lines, refuses, write_maps
from networks import write_photos, write_settings
from PIL import Image

from ssrvlad_torch import Map
from ssrvlad_torch.recognition.recognise import Steps

LATE = Steps(follow="online", delay=2)


@pytest.fixture
def photographed(tmp_path, monkeypatch):
    """A map of eight photographs, in a folder beside it, with features and HOG."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_photos(tmp_path / "photos", range(8), (60, 80))
    town = Map.open(tmp_path / "seen.ssrdb", write_settings(tmp_path, f"labels_as: {SPACE}\n"))
    town.add(tmp_path / "photos")
    return town


def read(files):
    return [np.asarray(Image.open(file)) for file in files]


def labels_of(folder):
    """A sequence of 32 label maps, the first of them in the map."""
    return read(sorted(write_maps(folder, range(32)).glob("*.png")))


def the_same(answers, others):
    """Whether they are equal; a pose may be unknown."""
    return list(map(repr, answers)) == list(map(repr, others))


def shown(tracker, frames, first=0):
    """The answers to frames that are called by their numbers."""
    answers = [tracker.update(frame, f"f{n}", n / 2) for n, frame in enumerate(frames, first)]
    return [answer for answer in answers if answer]


def test_the_answers_are_those_of_a_query_online_of_a_folder(drawn, tmp_path):
    frames = labels_of(tmp_path / "today")
    tracker = drawn.tracker(LATE, top=10**6)
    answers = shown(tracker, frames) + tracker.finish()
    assert [answer.query for answer in answers] == [f"f{n}" for n in range(32)]
    assert [answer.stamp for answer in answers] == [n / 2 for n in range(32)]
    assert [answer.settled for answer in answers] == [False] * 30 + [True] * 2
    whole = drawn.query(tmp_path / "today", LATE, 10**6)
    assert the_same(
        [a._replace(query="", stamp=None) for a in answers], [a._replace(query="") for a in whole]
    )


def test_pictures_find_their_places(photographed, tmp_path):
    files = [tmp_path / "photos" / f"{number}.png" for number in range(8)]
    tracker = photographed.tracker()
    by_path = [tracker.update(file) for file in files]
    assert [answer.query for answer in by_path] == [str(file) for file in files]
    assert [a.candidates[0].frame for a in by_path] == [f"photos/{n}" for n in range(8)]
    in_memory = photographed.tracker()
    numbered = [answer._replace(query=str(n)) for n, answer in enumerate(by_path)]
    assert the_same(map(in_memory.update, read(files)), numbered)
    refuses(
        "expected images and a segmenter, got a label map", tracker.update, read(files)[0][..., 0]
    )
    assert tracker.update(files[7]).candidates[0].frame == "photos/7", "it goes on"


def test_a_tracker_goes_on_from_a_file_with_the_names_that_wait(drawn, tmp_path):
    frames = labels_of(tmp_path / "today")
    whole = drawn.tracker(LATE)
    expected = shown(whole, frames) + whole.finish()
    first, second = drawn.tracker(LATE), drawn.tracker(LATE)
    answers = shown(first, frames[:11])
    first.save(tmp_path / "state")
    second.load(tmp_path / "state")
    assert the_same(answers + shown(second, frames[11:], 11) + second.finish(), expected)
    for content in (b"", b"[]", b"[1]\n", b"\xff\n", (tmp_path / "state").read_bytes()[:-1]):
        (tmp_path / "damaged").write_bytes(content)
        refuses(
            "damaged: no state to go on from: ",
            drawn.tracker(LATE).load,
            tmp_path / "damaged",
        )


def test_a_state_may_be_larger_than_other_files(drawn, tmp_path, monkeypatch):
    monkeypatch.setenv("SSRVLAD_FILE_LIMIT", "100")
    tracker = drawn.tracker()
    tracker.save(tmp_path / "state")
    drawn.tracker().load(tmp_path / "state")


@pytest.mark.parametrize("step", [12, pytest.param(1, marks=pytest.mark.slow)])
def test_after_an_interrupted_update_later_answers_have_their_names(drawn, tmp_path, step):
    """The frame was taken, or it was not; each later answer is to the frame of its name."""
    frames = labels_of(tmp_path / "today")[:8]
    lines = Lines(["search/tracker.py", "native/tracker.py"])
    tracker, without = drawn.tracker(LATE), drawn.tracker(LATE)
    shown(tracker, frames[:3])
    lines.run(partial(tracker.update, frames[3], "f3", 1.5))
    expected = [
        shown(drawn.tracker(LATE), frames)[2:],
        shown(without, frames[:3]) and shown(without, frames[4:], 4),
    ]
    outcomes = set[int]()
    for at in sorted({*range(1, lines.count + 1, step), *range(lines.count - 9, lines.count + 1)}):
        tracker = drawn.tracker(LATE)
        shown(tracker, frames[:3])
        assert Lines(["search/tracker.py", "native/tracker.py"], at).run(
            partial(tracker.update, frames[3], "f3", 1.5)
        )
        answers = shown(tracker, frames[4:], 4)
        same = [the_same(answers, possible) for possible in expected]
        assert any(same)
        outcomes.add(same.index(True))
    assert outcomes == {0, 1}


def test_what_is_no_tracker_is_refused(drawn, photographed, tmp_path):
    refuses("follow: expected online, got offline", drawn.tracker, Steps())
    refuses("holds no frames yet", Map.open(tmp_path / "none.ssrdb", labels_as=SPACE).tracker)
    settings = (tmp_path / "net.yaml").read_text()
    (tmp_path / "other.yaml").write_text(settings.replace("std: [1, 1, 1]", "std: [2, 2, 2]"))
    other = Map.open(photographed.path, tmp_path / "other.yaml")
    refuses("gives other label maps", other.tracker().update, tmp_path / "photos" / "0.png")


@pytest.fixture
def arrive(monkeypatch):
    def names(*files):
        lines = "".join(f"{file}\n" for file in files).encode()
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(lines)))

    return names


def test_pictures_whose_names_arrive_are_labelled_by_the_network_of_the_map(
    photographed, ssrvlad, arrive, tmp_path
):
    (tmp_path / "photos" / "9.png").write_text("no picture")
    arrive(*(tmp_path / "photos" / f"{number}.png" for number in (2, 9, 5)))
    given = ("query", photographed.path, "-", "--follow", "online", "--top", 10**6, "--json")
    code, out, lines = ssrvlad(*given)
    assert code == 3 and sum("9.png" in line for line in lines) == 1
    answers = [json.loads(line) for line in out.splitlines()]
    assert [a["candidates"][0]["frame"] for a in answers] == ["photos/2", "photos/5"]
    assert [len(a["candidates"]) for a in answers] == [8, 8]
    assert answers[0]["settled"] is False and {*answers[0]["poses"][0]} == {"x", "y", "heading"}


def test_a_frame_that_cannot_be_read_is_named_before_the_next_one_comes(
    photographed, ssrvlad, monkeypatch, capsys, tmp_path
):
    until_next = []

    def lines():
        yield f"{tmp_path / 'none.png'}\n".encode()
        until_next.append(capsys.readouterr().err)
        yield f"{tmp_path / 'photos' / '2.png'}\n".encode()

    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=lines()))
    code, out, err = ssrvlad("query", photographed.path, "-", "--follow", "online")
    assert code == 3 and out.startswith("photos/2: ")
    assert "none.png" in until_next[0] and not any("none.png" in line for line in err)


def test_no_name_on_standard_input_is_said(photographed, ssrvlad, arrive):
    arrive()
    code, out, lines = ssrvlad("query", photographed.path, "-", "--follow", "online")
    assert (code, out, lines[-1]) == (0, "", "ssrvlad: no name came on standard input")
