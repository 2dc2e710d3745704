"""The ROS 2 package: its core as it is, the node between stand-ins for ROS."""

from __future__ import annotations

import ast
import importlib
import json
import math
import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers import street

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.taxonomy import CATEGORIES, label_space, label_space_names

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "export" / "ros2"
sys.path.append(str(PACKAGE))
label_table = importlib.import_module("ssrvlad_ros.label_table")
live_loops = importlib.import_module("ssrvlad_ros.live_loops")
sys.path.remove(str(PACKAGE))

CAMVID = [(each.id, each.name) for each in label_space("camvid-11").classes]
SEEDS = (*range(40), *range(10, 24))
"""A drive of forty places that comes back to fourteen of them."""
CONFIG = LoopConfig(exclude=5, sweep=False)
SECOND = 10**9


def picture(labels, encoding="mono8", padding=0, big=0):
    """A ``sensor_msgs/Image``."""
    stored = labels.astype(live_loops.DTYPES[encoding].replace("u", ">u" if big else "<u"))
    rows = [row.tobytes() + b"\x63" * padding for row in stored]
    return SimpleNamespace(
        height=labels.shape[0],
        width=labels.shape[1],
        encoding=encoding,
        is_bigendian=big,
        step=labels.shape[1] * stored.itemsize + padding,
        data=b"".join(rows),
    )


def categories(labels, space):
    """``(H, W)`` indices of categories, 8 for none."""
    table = {each.id: each.category_index for each in label_space(space).classes}
    return np.vectorize(table.get)(labels)


@pytest.mark.parametrize("space", label_space_names())
def test_ids_come_to_stand_for_the_same_categories(space):
    """Of every label space of the package, shown as a network publishes it; bridge and tunnel mean
    in Cityscapes what they do not in CamVid."""
    known = [each for each in label_space(space).classes if each.id >= 0]
    table = label_table.LabelTable([(each.id, each.name.upper()) for each in known])
    ids = np.array([[each.id for each in known]], np.uint8)
    got = categories(table(ids), label_table.LABELS_AS)
    differing = {
        each.name
        for each, one, other in zip(known, got[0], categories(ids, space)[0], strict=True)
        if one != other
    }
    assert differing <= ({"Bridge", "Tunnel"} if space == "camvid-32" else set())


def test_a_table_in_any_order_and_with_gaps():
    table = label_table.LabelTable([(40, "Traffic_Light"), (7, "road"), (3, "SKY"), (900, "car")])
    labels = np.array([[3, 7, 40, 900]], np.uint16)
    assert categories(table(labels), "cityscapes-ids").tolist() == [[5, 0, 3, 8]]


def test_names_of_ones_own_are_given_a_meaning():
    class_map = [(0, "asphalt"), (1, "Sky"), (2, "drone")]
    with pytest.raises(ValueError, match="3 classes, of unknown meaning: 'asphalt', 'drone'; say"):
        label_table.LabelTable(class_map)
    meanings = {"Asphalt": "ground", "drone": "dynamic", "sky": "void"}
    table = label_table.LabelTable(class_map, meanings)
    got = categories(table(np.array([[0, 1, 2]], np.uint8)), "cityscapes-ids")
    assert got.tolist() == [[CATEGORIES.index("ground"), 8, 8]]
    with pytest.raises(ValueError, match="unknown category 'street'; expected one of ground, "):
        label_table.LabelTable(class_map, {"asphalt": "street"})


def test_the_largest_id_is_unlabelled_unless_the_table_has_it():
    table = label_table.LabelTable([(1, "sky")])
    for dtype, largest in ((np.uint8, 255), (np.uint16, 65535)):
        labels = np.array([[1, largest]], dtype)
        assert categories(table(labels), "cityscapes-ids").tolist() == [[5, 8]]
    with pytest.raises(ValueError, match=r"1 of 2 pixels .* such as 255"):
        table(np.array([[1, 255]], np.uint16))
    everywhere = label_table.LabelTable([(255, "sky")])
    assert categories(everywhere(np.full((1, 1), 255, np.uint8)), "cityscapes-ids")[0, 0] == 5


def test_an_id_without_a_name_is_refused():
    table = label_table.LabelTable(CAMVID)
    with pytest.raises(ValueError, match=r"6 of 24 pixels .* lacks, such as 77"):
        table(np.repeat([0, 5, 77, 11], 6).reshape(4, 6).astype(np.uint8))


@pytest.mark.parametrize(
    ("class_map", "message"),
    [
        ([], "has 0 classes, of unknown meaning: all"),
        ([(1, "sky"), (1, "road")], "id 1 of 'road' stands twice"),
        ([(-1, "sky")], "id -1 of 'sky'"),
        ([(65536, "sky")], "id 65536 of 'sky'"),
    ],
)
def test_wrong_tables_are_refused(class_map, message):
    with pytest.raises(ValueError, match=message):
        label_table.LabelTable(class_map)


@pytest.mark.parametrize("encoding", live_loops.DTYPES)
@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("big", [0, 1])
def test_images_are_read_whatever_their_rows_and_bytes(encoding, padding, big):
    labels = np.arange(35).reshape(5, 7) * (7 if "8" in encoding else 1800)
    image = picture(labels, encoding, padding, big)
    np.testing.assert_array_equal(live_loops.decode(image), labels)
    image.data = np.frombuffer(image.data, np.uint8)  # what rclpy gives is an array
    np.testing.assert_array_equal(live_loops.decode(image), labels)


def test_images_of_another_form_are_refused():
    image = picture(np.zeros((3, 4), int))
    for changes, message in (
        ({"encoding": "rgb8"}, "encoding 'rgb8'; expected one of mono8, 8UC1, mono16, 16UC1"),
        ({"step": 3}, "12 bytes in rows of 3; expected 3 rows of 4"),
        ({"height": 4}, "12 bytes in rows of 4; expected 4 rows of 4"),
        ({"height": 0}, "expected 0 rows of 4"),
    ):
        with pytest.raises(ValueError, match=message):
            live_loops.decode(SimpleNamespace(**{**vars(image), **changes}))


@pytest.mark.parametrize("angle", [0.0, 0.5, -2.0, 3.1])
def test_the_heading_of_a_rotation(angle):
    """About the vertical axis, and the same with a little roll before it."""
    w, z = math.cos(angle / 2), math.sin(angle / 2)
    assert live_loops.heading(live_loops.Quaternion(0, 0, z, w)) == pytest.approx(angle)
    r, x = math.cos(0.1), math.sin(0.1)
    rolled = live_loops.Quaternion(w * x, z * x, z * r, w * r)
    assert live_loops.heading(rolled) == pytest.approx(angle)


def test_meanings_are_given_as_words():
    assert live_loops.meanings_of(["", "a=b=sky", "x=void"]) == {"a=b": "sky", "x": "void"}
    for word in ("sky", "=sky", "road="):
        with pytest.raises(ValueError, match=f"expected name=category, got '{word}'"):
            live_loops.meanings_of([word])


def seen(core, seeds=SEEDS, start=0):
    """What a core says of a drive, a frame a second."""
    return [
        json.loads(core.see(picture(street(seed)), number * SECOND, (number, -1.0, 0.5)))
        for number, seed in enumerate(seeds, start)
    ]


def test_it_finds_what_the_detector_finds():
    core = live_loops.LiveLoops(CONFIG, "monday")
    core.learn_labels(CAMVID)
    detector = LoopDetector(CONFIG, SSRVLAD.from_preset("default", labels_as="camvid-11"))
    expected = [
        detector.update(street(seed), f"monday/{number * SECOND:019d}", number, (number, -1.0, 0.5))
        for number, seed in enumerate(SEEDS)
    ]
    got = seen(core)
    assert sum(line["reason"] == "accepted" for line in got) == 5
    for line, result in zip(got, expected, strict=True):
        assert line == {**result._asdict(), "reason": result.reason.value}


def test_without_a_table_nothing_is_seen_and_a_wrong_one_changes_nothing():
    core = live_loops.LiveLoops(CONFIG)
    with pytest.raises(ValueError, match="no table of labels has come yet"):
        seen(core, [1])
    core.learn_labels(CAMVID)
    with pytest.raises(ValueError, match="unknown meaning: 'x'"):
        core.learn_labels([(1, "x")])
    assert seen(core, [1])[0]["reason"] == "no_candidate"


def test_time_must_not_go_back():
    core = live_loops.LiveLoops(CONFIG)
    core.learn_labels(CAMVID)
    seen(core, [1], start=5)
    with pytest.raises(ValueError, match=r"expected a stamp from 5\.0 on, got 4\.0"):
        seen(core, [1], start=4)
    with pytest.raises(ValueError, match="was there before"):
        seen(core, [1], start=5)


def test_frames_are_kept_and_gone_on_from(tmp_path, monkeypatch):
    monkeypatch.setattr(live_loops, "CHECKPOINT_FRAMES", 6)
    whole = live_loops.LiveLoops(CONFIG)
    whole.learn_labels(CAMVID)
    expected = seen(whole)
    memory = tmp_path / "drive.ssrdb"
    first = live_loops.LiveLoops(CONFIG, memory=memory)
    first.learn_labels(CAMVID)
    got = seen(first, SEEDS[:14])
    assert len(Database.open(memory)) == 12  # what a crash leaves
    first.save()
    second = live_loops.LiveLoops(CONFIG, memory=memory)
    second.learn_labels(CAMVID)
    got += seen(second, SEEDS[14:], 14)
    assert [line["frame"] for line in got] == [line["frame"] for line in expected]
    assert got[-1]["candidate"] == expected[-1]["candidate"]
    second.save()
    stored = Database.open(memory)
    assert stored.load().poses[3].tolist() == [3, -1, 0.5]
    labels = second._table(street(0))
    assert stored.known()[f"drive/{0:019d}"].digest == digest(labels)


class StandInNode:
    """What `rclpy.node.Node` is asked for."""

    given: dict = {}  # noqa: RUF012

    def __init__(self, name):
        self.name, self.published, self.said, self.listeners = name, [], [], {}

    def declare_parameter(self, name, default):
        assert type(self.given.get(name, default)) is type(default)
        return SimpleNamespace(value=self.given.get(name, default))

    def create_publisher(self, kind, topic, depth):
        assert (kind.__name__, topic) == ("String", "loops")
        return SimpleNamespace(publish=lambda message: self.published.append(message.data))

    def create_subscription(self, kind, topic, callback, quality):
        self.listeners[topic] = kind.__name__, callback, quality

    def get_logger(self):
        return SimpleNamespace(error=self.said.append, warning=self.said.append)

    def destroy_node(self):
        self.said.append("destroyed")


def module(name, **contents):
    made = ModuleType(name)
    vars(made).update(contents)
    return made


@pytest.fixture
def node(monkeypatch):
    """The module `loop_node` between stand-ins."""
    messages = {
        "nav_msgs": ["Odometry"],
        "sensor_msgs": ["Image"],
        "std_msgs": ["String"],
        "vision_msgs": ["LabelInfo"],
    }
    for package, names in messages.items():
        kinds = {name: type(name, (SimpleNamespace,), {}) for name in names}
        monkeypatch.setitem(sys.modules, package, module(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module(f"{package}.msg", **kinds))
    durability = SimpleNamespace(TRANSIENT_LOCAL="latched", VOLATILE="volatile")
    quality = module(
        "rclpy.qos",
        DurabilityPolicy=durability,
        QoSProfile=lambda depth, durability: (depth, durability),
        qos_profile_sensor_data="sensor",
    )
    rclpy = module("rclpy", init=lambda: None, try_shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.node", module("rclpy.node", Node=StandInNode))
    monkeypatch.setitem(sys.modules, "rclpy.qos", quality)
    monkeypatch.delitem(sys.modules, "ssrvlad_ros.loop_node", raising=False)
    monkeypatch.syspath_prepend(PACKAGE)
    yield importlib.import_module("ssrvlad_ros.loop_node")
    sys.modules.pop("ssrvlad_ros.loop_node", None)


def stamped(labels, number):
    stamp = SimpleNamespace(sec=number, nanosec=7)
    return SimpleNamespace(**vars(picture(labels)), header=SimpleNamespace(stamp=stamp))


def odometry(x, y, angle):
    turned = live_loops.Quaternion(0, 0, math.sin(angle / 2), math.cos(angle / 2))
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y), orientation=turned)
    return SimpleNamespace(pose=SimpleNamespace(pose=pose))


def test_the_node_passes_messages_on(node, monkeypatch, tmp_path):
    given = {"exclude": 5, "sweep": False, "memory": str(tmp_path / "db")}
    monkeypatch.setattr(StandInNode, "given", given)
    made = node.LoopNode()
    kinds = {topic: (kind, quality) for topic, (kind, _, quality) in made.listeners.items()}
    assert kinds == {
        "label_info": ("LabelInfo", (1, "latched")),
        "odom": ("Odometry", 10),
        "labels": ("Image", "sensor"),
    }
    hear = {topic: callback for topic, (_, callback, _) in made.listeners.items()}
    hear["labels"](stamped(street(0), 0))
    assert made.said == ["frame skipped: no table of labels has come yet"]
    classes = [SimpleNamespace(class_id=i, class_name=name) for i, name in CAMVID]
    hear["label_info"](SimpleNamespace(class_map=classes))
    hear["label_info"](SimpleNamespace(class_map=[]))
    assert "has 0 classes" in made.said[1]
    for number, seed in enumerate(SEEDS, 1):
        hear["odom"](odometry(number, 2.0, 0.25))
        hear["labels"](stamped(street(seed), number))
    found = [json.loads(line) for line in made.published]
    assert [line["frame"] for line in found[:2]] == [f"drive/{n * SECOND + 7:019d}" for n in (1, 2)]
    assert sum(line["reason"] == "accepted" for line in found) == 5
    assert len(made.said) == 2
    made.close()
    poses = Database.open(tmp_path / "db").load().poses
    np.testing.assert_allclose(poses[:2], [[1, 2, 0.25], [2, 2, 0.25]])


def test_the_node_may_be_told_that_labels_are_not_latched(node, monkeypatch):
    monkeypatch.setattr(StandInNode, "given", {"latched": False, "meanings": ["x=sky"]})
    made = node.LoopNode()
    assert made.listeners["label_info"][2] == (1, "volatile")
    made._on_labels(SimpleNamespace(class_map=[SimpleNamespace(class_id=0, class_name="x")]))
    assert made.said == []


def test_the_node_saves_when_it_is_interrupted(node, monkeypatch, tmp_path):
    def spin(made):
        classes = [SimpleNamespace(class_id=i, class_name=name) for i, name in CAMVID]
        made._on_labels(SimpleNamespace(class_map=classes))
        made._on_image(stamped(street(0), 1))
        raise KeyboardInterrupt

    monkeypatch.setattr(StandInNode, "given", {"memory": str(tmp_path / "db")})
    monkeypatch.setattr(node.rclpy, "spin", spin, raising=False)
    node.main()
    assert len(Database.open(tmp_path / "db")) == 1


def test_only_the_node_imports_ros():
    inside = PACKAGE / "ssrvlad_ros"
    ros = {"rclpy", "nav_msgs", "sensor_msgs", "std_msgs", "vision_msgs"}
    for file in inside.glob("*.py"):
        imports = list(ast.walk(ast.parse(file.read_text())))
        names = {a.name for n in imports if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module or "" for n in imports if isinstance(n, ast.ImportFrom)}
        found = {name.partition(".")[0] for name in names} & ros
        assert found == (ros if file.stem == "loop_node" else set()), file


def test_the_package_declares_what_it_needs():
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    needs = {each.text for each in manifest.iter("exec_depend")}
    assert needs == {"rclpy", "nav_msgs", "sensor_msgs", "std_msgs", "vision_msgs"}
    setup = (PACKAGE / "setup.py").read_text()
    assert f'version="{manifest.findtext("version")}"' in setup
    assert (PACKAGE / "resource" / manifest.findtext("name")).is_file()
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["name"] in setup
