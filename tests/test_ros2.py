"""The ROS 2 package: the node over a bag, with the messages of rosbags and a stand-in for rclpy."""

import importlib
import json
import math
import sys
import tomllib
import zlib
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from exported import without_property
from helpers import refused, street, write_image
from loop_streams import CAMVID, CONFIG, SEEDS, assert_same_answers, objects, picture, seen
from networks import photo
from ros_stand_in import KINDS, PACKAGE, TYPES, StandInNode, module
from ssrvlad_ros import live_loops

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.datasets.image_files import find_image_files, read_image

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def store():
    """The messages, with all their fields, as the library of bags knows them."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in TYPES.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


@pytest.fixture
def node(monkeypatch, store):
    """The module `loop_node` with the messages of a type store and a stand-in for rclpy."""
    for package in {name.partition("/")[0] for name in store.types}:
        kinds = {n.rpartition("/")[2]: t for n, t in store.types.items() if n.startswith(package)}
        monkeypatch.setitem(sys.modules, package, module(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module(f"{package}.msg", **kinds))
    monkeypatch.setattr(StandInNode, "store", store)
    rclpy = {
        "rclpy": {"init": lambda: None, "try_shutdown": lambda: None},
        "rclpy.executors": {"ExternalShutdownException": type("Shutdown", (Exception,), {})},
        "rclpy.node": {"Node": StandInNode},
        "rclpy.qos": {
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="latched", VOLATILE="volatile"),
            "QoSProfile": lambda depth, durability: (depth, durability),
            "qos_profile_sensor_data": "sensor",
        },
    }
    for name, contents in rclpy.items():
        monkeypatch.setitem(sys.modules, name, module(name, **contents))
    monkeypatch.delitem(sys.modules, "ssrvlad_ros.loop_node", raising=False)
    monkeypatch.syspath_prepend(PACKAGE)
    yield importlib.import_module("ssrvlad_ros.loop_node")
    sys.modules.pop("ssrvlad_ros.loop_node", None)


def header(types, number):
    stamp = types["builtin_interfaces/msg/Time"](sec=number, nanosec=7)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


def label_info(types, classes):
    kind = types["vision_msgs/msg/VisionClass"]
    class_map = [kind(class_id=number, class_name=name) for number, name in classes]
    return types[KINDS["label_info"]](header=header(types, 0), class_map=class_map, threshold=0.0)


def image(types, pixels, number, encoding="mono8"):
    fields = {**vars(picture(pixels, encoding)), "header": header(types, number)}
    fields["data"] = np.frombuffer(fields["data"], np.uint8)
    return types[KINDS["labels"]](**fields)


def odometry(types, x, y, angle):
    message = {name.rpartition("/")[2]: kind for name, kind in types.items()}
    rotation = message["Quaternion"](x=0.0, y=0.0, z=math.sin(angle / 2), w=math.cos(angle / 2))
    pose = message["Pose"](position=message["Point"](x=x, y=y, z=0.0), orientation=rotation)
    still = message["Vector3"](x=0.0, y=0.0, z=0.0)
    return message["Odometry"](
        header=header(types, 0),
        child_frame_id="",
        pose=message["PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=message["TwistWithCovariance"](
            twist=message["Twist"](linear=still, angular=still), covariance=np.zeros(36)
        ),
    )


def write_drive(path, store):
    """A bag: an image before the labels are known, the labels, and the drive of `SEEDS`."""
    rosbag2, types = pytest.importorskip("rosbags.rosbag2"), store.types
    messages = [("labels", image(types, street(0), 0)), ("label_info", label_info(types, CAMVID))]
    messages.append(("label_info", label_info(types, [])))
    for number, seed in enumerate(SEEDS, 1):
        messages.append(("odom", odometry(types, float(number), 2.0, 0.25)))
        messages.append(("labels", image(types, street(seed), number)))
    with rosbag2.Writer(path, version=9) as bag:
        topics = {
            topic: bag.add_connection(topic, KINDS[topic], typestore=store)
            for topic in ("label_info", "odom", "labels")
        }
        for time, (topic, message) in enumerate(messages):
            bag.write(topics[topic], time, store.serialize_cdr(message, KINDS[topic]))
    return path


def uncompressed(content):
    """`rtabmap::uncompressData` of a row of float32."""
    rows, columns, kind = np.frombuffer(content[-12:], np.int32)
    assert (rows, kind) == (1, 5)
    numbers = np.frombuffer(zlib.decompress(content[:-12]), np.float32)
    assert len(numbers) == columns
    return numbers


def test_the_node_over_a_bag(node, store, monkeypatch, tmp_path):
    """A bag is played to the node, and what it publishes is read again by the fields of its
    messages."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    given = {"exclude": 5, "sweep": False, "memory": str(tmp_path / "db")}
    monkeypatch.setattr(StandInNode, "given", given)
    running = node.LoopNode()
    qualities = {topic: quality for topic, (_, quality) in running.listeners.items()}
    assert qualities == {"label_info": (1, "latched"), "odom": 10, "labels": "sensor"}
    with rosbag2.Reader(write_drive(tmp_path / "bag", store)) as bag:
        for connection, _, content in bag.messages():
            message = store.deserialize_cdr(content, connection.msgtype)
            running.listeners[connection.topic][0](message)
    assert running.said[0] == "frame skipped: no table of labels has come yet"
    assert "has 0 classes" in running.said[1] and len(running.said) == 2
    described, loops = running.sent("descriptor"), running.sent("loops")
    assert [m.header.stamp.sec for m in described] == [*range(1, len(SEEDS) + 1)]
    head = SSRVLAD.from_preset("default", labels_as="camvid-11")
    for seed, message in zip(SEEDS[:3], described, strict=False):
        expected = head(street(seed)[None])[0].numpy()
        np.testing.assert_allclose(uncompressed(message.data.tobytes()), expected, atol=1e-6)
    core = live_loops.LiveLoops(CONFIG)
    core.set_labels(CAMVID)
    results = seen(core, start=1)
    said = [json.loads(message.data) for message in running.sent("results")]
    places = [[place._asdict() for place in result.candidates] for result in results]
    assert [each["reason"] for each in said] == [result.reason for result in results]
    assert [len(each["candidates"]) for each in said] == [*map(len, places)]
    assert max(map(len, places)) > 0
    closed = [result for result in results if result.accepted]
    pairs = [(int(r.frame[-19:-9]), int(r.candidate[-19:-9])) for r in closed]
    assert len(pairs) == 12
    assert [(m.header.stamp.sec, m.time_ref.sec) for m in loops] == pairs
    assert {(m.header.stamp.nanosec, m.time_ref.nanosec) for m in loops} == {(7, 7)}
    assert {m.source for m in loops} == {"drive"}
    running.close()
    poses = Database.open(tmp_path / "db").load().poses
    np.testing.assert_allclose(poses[:2], [[1, 2, 0.25], [2, 2, 0.25]])


def show_one(running, types):
    """The table of labels, and a label map."""
    running._on_labels(label_info(types, CAMVID))
    running._on_image(image(types, street(0), 1))


@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
def test_the_node_saves_when_it_is_interrupted_or_terminated(
    node, store, monkeypatch, tmp_path, signal
):
    def spin(running):
        show_one(running, store.types)
        shutdown = sys.modules["rclpy.executors"].ExternalShutdownException
        raise {"SIGINT": KeyboardInterrupt, "SIGTERM": shutdown}[signal]

    monkeypatch.setattr(StandInNode, "given", {"memory": str(tmp_path / "db")})
    monkeypatch.setattr(node.rclpy, "spin", spin, raising=False)
    node.main()
    assert len(Database.open(tmp_path / "db")) == 1


def test_a_memory_that_cannot_be_written_is_told_and_costs_no_result(
    node, store, monkeypatch, tmp_path
):
    def save(self):
        raise OSError("no space left on device")

    def spin(running):
        show_one(running, store.types)
        assert running.said == ["the memory cannot be written: no space left on device"]
        assert {topic for topic, _ in running.published} == {"descriptor", "results"}

    monkeypatch.setattr(StandInNode, "given", {"memory": str(tmp_path / "db")})
    monkeypatch.setattr(node.rclpy, "spin", spin, raising=False)
    monkeypatch.setattr("ssrvlad_ros.live_loops.CHECKPOINT_FRAMES", 1)
    monkeypatch.setattr("ssrvlad_ros.live_loops.LiveLoops.save", save)
    with refused("^ssrvlad_loops: no space left on device$", by=SystemExit):
        node.main()


SECOND_DRIVE = (*range(20), *range(4, 16))
"""Twenty places, and twelve of them again."""


@pytest.fixture
def node_with(node, monkeypatch, drives):
    """Starts the node with a model, and shows it the photos of some seeds, a second apart."""

    def run(seeds, **given):
        settings = {"model": str(drives / "place.onnx"), "exclude": 5, **given}
        monkeypatch.setattr(StandInNode, "given", settings)
        running = node.LoopNode()
        for number, seed in enumerate(seeds, 1):
            pixels = photo(street(seed, 96, 128))
            running._on_image(image(StandInNode.store.types, pixels, number, "rgb8"))
        return running

    return run


def columns(memory):
    return [column.name for column in Database.open(memory).columns]


def lines(running):
    return [json.loads(message.data) for message in running.sent("results")]


def test_the_node_reads_pictures_with_a_model(node_with, store, tmp_path):
    running = node_with(SECOND_DRIVE, memory=str(tmp_path / "db"))
    assert running.listeners.keys() == {"odom", "image"}
    running._on_image(image(store.types, street(0), 40, "mono16"))
    assert running.said == [
        "frame skipped: encoding 'mono16'; expected one of rgb8, bgr8, rgba8, bgra8, mono8"
    ]
    loops = running.sent("loops")
    assert len(loops) > 5
    assert all(each.header.stamp.sec - each.time_ref.sec == 16 for each in loops)
    running.close()
    assert columns(tmp_path / "db") == ["ssr-vlad", "features", "hog"]


def write_photos(folder, seeds, name="{:010d}000000007"):
    """Photos, by default under the names that the node gives them."""
    for number, seed in enumerate(seeds, 1):
        write_image(folder / f"{name.format(number)}.png", photo(street(seed, 96, 128)))
    return folder


def test_the_node_localises_in_a_known_map(node_with, ssrvlad, drives, tmp_path):
    """The answers are those of `ssrvlad query` online; one that is sure enough and has a pose is
    published with the stamp of its image."""
    monday, again = write_photos(tmp_path / "monday", range(40), "{}"), range(4, 16)
    rows = "".join(f"{n}.png,{n},{-n},{n / 10}\n" for n in range(1, 41) if n != 12)
    (monday / "poses.csv").write_text(f"frame,x,y,heading\n{rows}")
    town, network = tmp_path / "town", ("--segmenter", drives / "net.yaml")
    assert ssrvlad("encode", monday, "-o", town, *network)[0] == 0
    today, late = write_photos(tmp_path / "drive", again), ("--follow", "online", "--delay", 1)
    expected = objects(ssrvlad("query", town, today, *network, *late, "--json")[1])
    settings = {"delay": 1, "min_confidence": 0.5, "map_frame": "town", "sigma_metres": 2.0}
    running = node_with(again, map=str(town), **settings)
    answers = [json.loads(message.data) for message in running.sent("answers")]
    assert [line["query"] for line in answers] == [line["query"] for line in expected[:-1]]
    for line, right in zip(answers, expected, strict=False):
        assert line["candidates"][0]["frame"] == right["candidates"][0]["frame"]
        assert line["confidence"] == pytest.approx(right["confidence"], abs=1e-3)
        assert line["poses"][0] == right["poses"][0] and not line["settled"]
    posed = [line for line in answers if line["confidence"] >= 0.5 and line["poses"][0]["x"]]
    assert 5 < len(posed) < len(answers)
    poses = running.sent("pose")
    assert [f"drive/{m.header.stamp.sec:010d}{m.header.stamp.nanosec:09d}" for m in poses] == [
        line["query"] for line in posed
    ]
    for message, line in zip(poses, posed, strict=True):
        pose, place = message.pose.pose, line["poses"][0]
        assert (pose.position.x, pose.position.y) == (place["x"], place["y"])
        assert live_loops.heading(pose.orientation) == pytest.approx(place["heading"])
        assert message.header.frame_id == "town"
        assert np.flatnonzero(message.pose.covariance).tolist() == [0, 7, 35]
        assert message.pose.covariance[0] == 4
    assert len(running.sent("results")) == len(again)


def saved_by_a_detector(path, drives, folder):
    """A memory of photos as users of `LoopDetector` make it."""
    detector = LoopDetector.from_pretrained(drives / "net.yaml")
    for file in find_image_files([str(folder)]):
        detector.update(read_image(file), file.frame)
    stored = [channel.column for channel in detector.channels[1:]]
    detector.save(Database.create(path, detector.head.config, columns=stored))


@pytest.mark.parametrize("by", ["encode", "encode --channel hog", "detector"])
def test_a_memory_that_was_made_elsewhere_is_gone_on_from(node_with, ssrvlad, drives, tmp_path, by):
    """Its channels decide, and its frames have ids without a stamp."""
    monday, again = write_photos(tmp_path / "monday", range(20), "{}"), range(4, 18)
    drive, network = write_photos(tmp_path / "drive", again), ("--segmenter", drives / "net.yaml")
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for path in (ours, theirs):
        if by == "detector":
            saved_by_a_detector(path, drives, monday)
        else:
            assert ssrvlad(*by.split(), monday, "-o", path, *network)[0] == 0
    stored = columns(ours)
    assert stored == ["ssr-vlad", *(["hog"] if "hog" in by else ["features", "hog"])]
    running = node_with(again, memory=str(ours), threshold=0.7)
    given = ("--exclude", 5, "--threshold", 0.7, "--memory", theirs, "--json")
    code, out, _ = ssrvlad("loops", drive, *network, *given)
    answers = lines(running)
    assert code == 0
    assert_same_answers(answers, objects(out))
    closed = [line["candidate"] for line in answers if line["reason"] == "accepted"]
    assert len(closed) > 5 and all(each.startswith("monday/") for each in closed)
    loops = [(each.source, each.time_ref.sec) for each in running.sent("loops")]
    assert loops == [(candidate, 0) for candidate in closed]
    running.close()
    assert columns(ours) == stored and len(Database.open(ours)) == 20 + len(again)


def test_a_model_without_hog_goes_without_and_opens_no_memory_with_it(
    node, node_with, drives, tmp_path
):
    plain = without_property(drives / "place.onnx", tmp_path / "plain.onnx", "hog")
    with_hog, without = tmp_path / "with", tmp_path / "without"
    node_with([0], memory=str(with_hog)).close()
    node_with([0], memory=str(without), model=str(plain)).close()
    assert columns(without) == ["ssr-vlad", "features"]
    node_with([], memory=str(without))
    given = {"model": str(plain), "memory": str(with_hog)}
    problem = "has hog of its frames, which this stream has not: it gives ssr-vlad, features$"
    StandInNode.given.update(given)
    with refused(f"^ssrvlad_loops: .*{problem}", with_hog, by=SystemExit):
        node.main()


def test_wrong_parameters_are_one_line(node, monkeypatch, drives):
    monkeypatch.setattr(StandInNode, "given", {"model": str(drives / "head.onnx")})
    with refused("^ssrvlad_loops: .*got one that takes labels", by=SystemExit):
        node.main()


ROS = {
    "builtin_interfaces", "geometry_msgs", "nav_msgs", "rclpy", "rtabmap_msgs", "sensor_msgs",
    "std_msgs", "vision_msgs",
}  # fmt: skip


def test_the_package_declares_what_it_needs():
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    needs = {each.text for each in manifest.iter("exec_depend")}
    assert needs == ROS
    setup = (PACKAGE / "setup.py").read_text()
    assert f'version="{manifest.findtext("version")}"' in setup
    assert (PACKAGE / "resource" / manifest.findtext("name")).is_file()
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["name"] in setup
