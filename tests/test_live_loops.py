"""The core of the ROS 2 node, without ROS: label images, and pictures with a fused model."""

import math
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import onnx
import pytest
from exported import edit_golden, turned, without_property
from helpers import refused, refuses, street
from loop_streams import CAMVID, CONFIG, SECOND, SEEDS, picture, seen, updates
from networks import photo
from ssrvlad_ros import label_table, live_loops
from ssrvlad_ros.place_model import PlaceModel

from ssrvlad_torch import SSRVLAD, Database, SSRVLADConfig
from ssrvlad_torch.datasets.label_files import digest


@pytest.mark.parametrize("encoding", live_loops.DTYPES)
@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("big", [0, 1])
def test_images_are_read_whatever_their_rows_and_bytes(encoding, padding, big):
    labels = np.arange(35).reshape(5, 7) * (7 if "8" in encoding else 1800)
    image = picture(labels, encoding, padding, big)
    np.testing.assert_array_equal(live_loops.decode(image), labels)
    image.data = np.frombuffer(image.data, np.uint8)  # what rclpy gives is an array
    np.testing.assert_array_equal(live_loops.decode(image), labels)


@pytest.mark.parametrize("angle", [0.0, 0.5, -2.0, 3.1])
def test_the_heading_of_a_rotation(angle):
    """About the vertical axis, and the same with a little roll before it."""
    w, z = math.cos(angle / 2), math.sin(angle / 2)
    assert live_loops.heading(live_loops.Quaternion(0, 0, z, w)) == pytest.approx(angle)
    r, x = math.cos(0.1), math.sin(0.1)
    rolled = live_loops.Quaternion(w * x, z * x, z * r, w * r)
    assert live_loops.heading(rolled) == pytest.approx(angle)


def labelled(*given, **settings):
    """A core that knows the table of labels."""
    core = live_loops.LiveLoops(CONFIG, *given, **settings)
    core.set_labels(CAMVID)
    return core


def test_without_a_table_nothing_is_seen_and_a_wrong_one_changes_nothing():
    core = live_loops.LiveLoops(CONFIG)
    refuses("no table of labels has come yet", seen, core, [1])
    core.set_labels(CAMVID)
    refuses("unknown meaning: 'x'", core.set_labels, [(1, "x")])
    assert seen(core, [1])[0].reason == "no_candidate"


def test_a_machine_that_describes_otherwise_is_refused(tmp_path, monkeypatch):
    recorded = {name: array.copy() for name, array in np.load(live_loops.GOLDEN).items()}
    for preset in ("default", "paper"):
        head = SSRVLAD.from_preset(preset, labels_as=label_table.LABELS_AS)
        assert f"{head.config.fingerprint} labels" in recorded, "scripts/pages/ros_golden.py"
        live_loops.check_head(head)
    for name, numbers in recorded.items():
        if name.endswith("descriptor"):
            numbers[0, 3] += 1e-4
    np.savez(tmp_path / "golden.npz", **recorded)
    monkeypatch.setattr(live_loops, "GOLDEN", tmp_path / "golden.npz")
    refuses(r"wrong on this machine.* differ by 0\.0001", live_loops.LiveLoops, CONFIG)
    live_loops.LiveLoops(CONFIG, check=False)
    live_loops.check_head(SSRVLAD(SSRVLADConfig(labels_as="camvid-11", working_size=50)))


def test_frames_are_kept_and_gone_on_from(tmp_path, monkeypatch):
    monkeypatch.setattr(live_loops, "CHECKPOINT_FRAMES", 6)
    expected, memory = seen(labelled()), tmp_path / "drive.ssrdb"
    first = labelled(memory=memory)
    got = seen(first, SEEDS[:14])
    assert len(Database.open(memory)) == 12  # what a crash leaves
    first.save()
    second = labelled(memory=memory)
    got += seen(second, SEEDS[14:], 14)
    assert [result.frame for result in got] == [result.frame for result in expected]
    assert got[-1].candidate == expected[-1].candidate
    second.save()
    stored = Database.open(memory)
    frames = stored.load()
    assert (frames.stamps[3], frames.poses[3].tolist()) == (3, [3, -1, 0.5])
    labels = second._table(street(0))
    assert stored.known()[f"drive/{0:019d}"].digest == digest(labels)


def test_a_checkpoint_that_cannot_be_written_costs_no_result(tmp_path, monkeypatch):
    """It is said once, and tried again at the next one."""
    monkeypatch.setattr(live_loops, "CHECKPOINT_FRAMES", 6)
    core, problem = labelled(memory=tmp_path / "drive.ssrdb"), "no space left on device"
    with monkeypatch.context() as full:
        full.setattr(core, "save", Mock(side_effect=OSError(problem)))
        told = updates(core, SEEDS[:14])
    told += updates(core, SEEDS[14:], 14)
    assert [each.result for each in told] == seen(labelled())
    unsaved = {number: each.unsaved for number, each in enumerate(told) if each.unsaved}
    assert unsaved == {5: problem, 11: problem}
    assert len(Database.open(tmp_path / "drive.ssrdb")) == len(SEEDS) // 6 * 6


def test_a_memory_that_is_out_of_reach_costs_no_result(tmp_path, monkeypatch):
    """As a disk that is taken out and put in again."""
    monkeypatch.setattr(live_loops, "CHECKPOINT_FRAMES", 6)
    memory, away = tmp_path / "drive.ssrdb", tmp_path / "away"
    core = labelled(memory=memory)
    memory.rename(away)
    told = updates(core, SEEDS[:14])
    away.rename(memory)
    told += updates(core, SEEDS[14:], 14)
    assert [each.result for each in told] == seen(labelled())
    unsaved = [number for number, each in enumerate(told) if "does not exist" in each.unsaved]
    assert unsaved == [5, 11]
    assert len(Database.open(memory)) == len(SEEDS) // 6 * 6


@pytest.mark.parametrize("encoding", live_loops.CHANNELS)
@pytest.mark.parametrize("padding", [0, 5])
def test_pictures_are_read_in_rgb(encoding, padding):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 7, 4), np.uint8)
    order = {"b": [2, 1, 0, 3], "r": [0, 1, 2, 3], "m": [0, 0, 0]}[encoding[0]]
    sent = pixels[..., 0] if encoding == "mono8" else pixels[..., : len(encoding) - 1]
    got = live_loops.decode_picture(picture(sent, encoding, padding))
    np.testing.assert_array_equal(got, pixels[..., order][..., :3])


MAP = picture(np.zeros((3, 4), int))
RGB = picture(np.zeros((3, 4, 3), int), "rgb8")


@pytest.mark.parametrize(
    ("image", "changes", "message"),
    [
        (MAP, {"encoding": "rgb8"}, "encoding 'rgb8'; expected one of mono8, 8UC1, mono16, 16UC1"),
        (MAP, {"step": 3}, "12 bytes in rows of 3; expected 3 rows of 4"),
        (MAP, {"height": 4}, "12 bytes in rows of 4; expected 4 rows of 4"),
        (MAP, {"height": 0}, "expected 0 rows of 4"),
        (RGB, {"encoding": "8UC3"}, "'8UC3'; expected one of rgb8, bgr8, rgba8, bgra8, mono8"),
        (RGB, {"encoding": "mono16"}, "encoding 'mono16'; expected one of rgb8"),
        (RGB, {"step": 11}, "36 bytes in rows of 11; expected 3 rows of 12"),
        (RGB, {"encoding": "rgba8"}, "36 bytes in rows of 12; expected 3 rows of 16"),
        (RGB, vars(picture(street(0, 60, 80))), "expected a photograph, got a label map"),
    ],
)
def test_images_of_another_form_are_refused(image, changes, message):
    decode = live_loops.decode if image is MAP else live_loops.decode_picture
    refuses(message, decode, SimpleNamespace(**{**vars(image), **changes}))


def test_models_that_do_not_fit_are_refused(drives, tmp_path):
    without_property(drives / "place.onnx", tmp_path / "plain.onnx", "features")
    model = onnx.load(drives / "place.onnx")
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "other.onnx")
    (tmp_path / "torn.onnx").write_bytes(b"torn")
    edit_golden(drives / "place.onnx", tmp_path / "wrong.onnx", turned("features"))
    for path, message in (
        (tmp_path / "plain.onnx", "gives no features: fuse it again without --no-features, or"),
        (tmp_path / "other.onnx", "no metadata ssrvlad"),
        (tmp_path / "torn.onnx", "cannot run in ONNX Runtime"),
        (tmp_path / "wrong.onnx", "is computed wrong on this machine: .* of the signs"),
        (drives / "head.onnx", "expected a file of `ssrvlad fuse`, .*; got one that takes labels"),
        (tmp_path / "none.onnx", "No such file"),
    ):
        with refused(message, path.name, by=(ValueError, OSError)):
            PlaceModel(path)
    assert PlaceModel(tmp_path / "plain.onnx", features=False).fingerprint_of_features == ""
    assert PlaceModel(tmp_path / "wrong.onnx", check=False).fingerprint_of_features


def test_a_picture_that_the_network_cannot_take_changes_nothing(drives):
    core = live_loops.LiveLoops(CONFIG, model=PlaceModel(drives / "place.onnx"))
    core.update(picture(photo(street(0, 96, 128)), "rgb8"), 0)
    with pytest.raises(ValueError, match=r"not finite, or the same everywhere|fails at 1x1"):
        core.update(picture(np.zeros((1, 1, 3), int), "rgb8"), SECOND)
    assert len(core._detector) == 1
