"""The loop detector without torch: the rules of the package's, and the command line's answers."""

import dataclasses
import json
import math
import os
import subprocess
from functools import partial
from pathlib import Path

import loops_onnx
import numpy as np
import pytest
import torch
from helpers import street, without
from hypothesis import given
from loop_streams import LIGHT, PLACES, configs, noisy_stream, streams, unit, write_drive
from PIL import Image
from segmenting import write_drives
from ssrvlad_place import stream
from ssrvlad_place.loops import Detector, Settings
from ssrvlad_place.model import Seen

from ssrvlad_torch import SSRVLAD, LoopDetector, SSRVLADConfig
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.channels.live_signs import LiveSigns
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.loops import tracker
from ssrvlad_torch.loops.config import LoopConfig

CONFIG = SSRVLADConfig.from_preset("default", labels_as="camvid-11")
HEAD = SSRVLAD(CONFIG)
SETTINGS = ("--exclude", 5, "--threshold", 0.7)


@pytest.fixture
def run(main_of):
    return partial(main_of, loops_onnx.main, "loops_onnx.py")


@pytest.fixture
def drive(tmp_path):
    return write_drive(tmp_path / "drive")


def objects(out):
    return [json.loads(line) for line in out.splitlines()]


def likely(candidates):
    return {x["frame"]: x["probability"] for x in candidates if x["probability"] > 0.05}


def assert_same_answers(got, expected):
    """Scores may differ in their last digits."""
    assert len(got) == len(expected)
    for one, other in zip(got, expected, strict=True):
        assert [*one] == [*other]
        for name in ("frame", "reason", "candidate"):
            assert one[name] == other[name], one["frame"]
        for name in ("score", "probability"):
            assert one[name] == pytest.approx(other[name], abs=3e-4), one["frame"]
        places, wanted = (likely(each["candidates"]) for each in (one, other))
        assert places == pytest.approx(wanted, abs=3e-4), one["frame"]


@pytest.mark.parametrize("name", ["stretches.py", "tracks.py"])
def test_what_needs_no_torch_is_the_file_of_the_package(name):
    """To be copied without the package, it lies beside the programs too: one text, two places."""
    own = Path(loops_onnx.__file__).parent / "ssrvlad_place" / name
    assert own.read_bytes() == (Path(tracker.__file__).parent / name).read_bytes()


def test_its_defaults_are_those_of_the_package():
    plain = dataclasses.asdict(LoopConfig())
    assert Settings()._asdict() == {name: plain[name] for name in Settings._fields}


def test_what_is_excluded_costs_what_there_is():
    """Frames, and not settings, are stored and compared."""
    swept = [PLACES[number : number + 1] for number in range(40)]
    answers = []
    for exclude in (40, 10**12):
        loops = Detector(Settings(exclude=exclude))
        answers.append(
            [loops.update(f"drive/{n}", Seen(each, None)) for n, each in enumerate(swept)]
        )
    assert answers[0] == answers[1]


SHAPE = (16, 2, 8)
DRAWN = np.random.default_rng(0).normal(size=(120, 16 * 2 * 64)).astype(np.float32)


def signs_of(descriptor):
    """Features that are as alike as descriptors are."""
    return np.packbits(descriptor[:120] @ DRAWN > 0).reshape(SHAPE)


def hog_of(descriptor):
    """HOG that is as alike as descriptors are."""
    drawn = descriptor[:120] @ DRAWN[:, :480]
    return drawn / max(1e-9, np.linalg.norm(drawn))


class Drawn(Features):
    def live(self):
        return LiveSigns(SHAPE)


def both(stream, config, pictures=False, stamps=None):
    """What the program and the package say of a stream, also with features and HOG of pictures."""
    stamps = stamps or [math.nan] * len(stream[1])
    chosen = {name: getattr(config, name) for name in Settings._fields}
    theirs = Detector(Settings(**chosen))
    ours = LoopDetector(config, HEAD, [Drawn("drawn"), HOG()] if pictures else [])
    got, expected = [], []
    for number, (swept, sequence) in enumerate(zip(*stream, strict=True)):
        usual = swept[len(swept) // 2]
        given = {"features": signs_of(usual), "hog": hog_of(usual)} if pictures else {}
        seen = Seen(swept, **given)
        got.append(theirs.update(f"{sequence}/{number}", seen, stamps[number]).as_json())
        record = FrameRecord(sequence, str(number), stamp=stamps[number])
        described = {"ssr-vlad": torch.from_numpy(swept)}
        described |= {name: torch.from_numpy(channel) for name, channel in given.items()}
        expected.append(ours.observe(record, described).as_json())
    return got, expected


@given(streams, configs)
def test_it_follows_the_rules_of_the_package(stream, config):
    """Of two candidates that are alike to the last digits either may be named, and at the very
    threshold either answer given."""
    for one, other in zip(*both(stream, config), strict=True):
        if one["probability"] is None or other["probability"] is None:
            assert one == {**other, "reason": other["reason"].value}
            continue
        assert one["probability"] == pytest.approx(other["probability"], abs=2e-3)
        if abs(other["probability"] - config.threshold) > 4e-3 and one["reason"] == "accepted":
            assert other["reason"] == "accepted"
        if other["probability"] > 0.9:
            assert one["score"] == pytest.approx(other["score"], abs=1e-3)


@pytest.mark.parametrize("pictures", [False, True])
@pytest.mark.parametrize(("anchors", "exclude", "places"), [(1, 5, 40), (3, 5, 40), (1, 100, 130)])
def test_a_long_stream_passes_the_end_of_a_block(monkeypatch, anchors, exclude, places, pictures):
    monkeypatch.setattr(stream, "BLOCK_ROWS", 16)
    drives = noisy_stream(2, 300, places, [100], anchors)
    got, expected = both(drives, LoopConfig(exclude=exclude), pictures)
    sure = [row for row, line in enumerate(expected) if line["reason"].value == "accepted"]
    assert len(sure) > 25
    assert_same_answers([got[row] for row in sure], [expected[row] for row in sure])


@pytest.mark.parametrize("pictures", [False, True])
def test_a_gap_of_stamps_starts_a_stretch(pictures):
    """Another drive of the same name, in other light, after an hour."""
    street = PLACES[:200] + PLACES[1:201]
    vectors = unit(np.concatenate((street[:150], street[40:120] + LIGHT)))
    stamps = [n + 3600.0 * (n >= 150) for n in range(230)]
    drives = vectors[:, None], ["drive"] * 230
    got, expected = both(drives, LoopConfig(), pictures, stamps)
    assert_same_answers(got, expected)
    unstamped, _ = both(drives, LoopConfig(), pictures)
    closed = [sum(each["reason"] == "accepted" for each in answers) for answers in (got, unstamped)]
    assert closed[0] > closed[1] + 20


def test_with_all_channels_another_light_needs_no_gap():
    rng = np.random.default_rng(0)
    noise = [rng.normal(0, 0.3 / 22, (230, 480)), 0.35 * LIGHT]
    street = PLACES[:300] + PLACES[1:301]
    vectors = unit(np.concatenate((street[:150], street[40:120] + noise[1])) + noise[0])
    got, expected = both((vectors[:, None], ["drive"] * 230), LoopConfig(), pictures=True)
    assert_same_answers(got, expected)
    assert sum(each["reason"] == "accepted" for each in got) > 30


def test_an_empty_frame_is_no_candidate():
    empty_at_first = np.float32(PLACES[:100, None])
    empty_at_first[:36] = 0
    got, _ = both((empty_at_first, ["drive"] * 100), LoopConfig())
    assert all(math.isfinite(each["score"] or 0) for each in got)


def test_with_all_channels_it_says_what_the_command_line_says(ssrvlad, tmp_path, run):
    """Of photographs, over a second drive along the first, by one file and by two."""
    write_drives(tmp_path, range(20), range(4, 18), (96, 128))
    streams = (tmp_path / "monday", tmp_path / "today")
    given = ("--segmenter", tmp_path / "net.yaml", "--no-sweep")
    code, out, err = ssrvlad("loops", *streams, *given, *SETTINGS, "--json", "--workers", 1)
    assert (code, err) == (0, [])
    expected = objects(out)
    assert sum(line["reason"] == "accepted" for line in expected) > 5
    two = (tmp_path / "head.onnx", "--network", tmp_path / "net.onnx")
    for model in ((tmp_path / "place.onnx",), two):
        code, out, err = run(*model, *streams, *SETTINGS)
        assert (code, err) == (0, [])
        assert_same_answers(objects(out), expected)


@pytest.mark.parametrize("live", [False, True])
def test_without_torch_it_says_what_the_command_line_says(ssrvlad, head, drive, live):
    """Over a folder, and name by name, the next only once the last is answered."""
    expected = objects(
        ssrvlad("loops", drive, "--labels-as", "camvid-11", *SETTINGS, "--no-sweep", "--json")[1]
    )
    assert sum(line["reason"] == "accepted" for line in expected) > 3
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = (Path(loops_onnx.__file__), head, "-" if live else drive, *SETTINGS)
    with subprocess.Popen(without(("torch", "ssrvlad_torch"), *command), **pipes) as process:
        lines = []
        for path in sorted(drive.iterdir()) if live else []:
            process.stdin.write(os.fsencode(path) + b"\n")
            process.stdin.flush()
            lines.append(process.stdout.readline())
        out, err = process.communicate()
    assert (process.returncode, err) == (0, b"")
    assert_same_answers(objects(b"".join(lines) + out), expected)


def test_a_bad_frame_is_refused_and_the_stream_goes_on(head, drive, run):
    (drive / "07.png").write_text("no picture")
    Image.fromarray(street(0) + 100).save(drive / "09.png")
    code, out, err = run(head, drive, drive / "03.png", *SETTINGS)
    assert (code, len(objects(out)), len(err)) == (3, 52, 4)
    assert err[0].endswith("frame drive/03 was there before")
    assert err[1].startswith(f"{drive / '07.png'}: ")
    assert err[2].endswith("pixels have an id outside label space camvid-11")
    assert err[3] == "skipped 3 of 55 frames"


def test_wrong_use_is_one_line(head, drive, tmp_path, run):
    code, out, (error,) = run(tmp_path / "none.onnx", drive)
    assert (code, out) == (2, "")
    assert error.startswith("loops_onnx: ")
    (tmp_path / "empty").mkdir()
    for folder, problem in (
        ("nowhere", "does not exist; expected a file or a folder of frames"),
        ("empty", "holds no frames; expected .png, .npy, .tif, .tiff, .bmp files"),
    ):
        code, _, (error,) = run(head, tmp_path / folder)
        assert (code, error) == (2, f"loops_onnx: {tmp_path / folder} {problem}")
    for wrong in (("-", drive), (drive, "--exclude", -1), (drive, "--threshold", 2)):
        code, _, errors = run(head, *wrong)
        assert code == 2
        assert errors[-1].endswith(
            "expected --exclude from 0, --threshold from 0 to 1, and - alone"
        )
