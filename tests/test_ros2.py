"""The ROS 2 package: its core as it is, the node over a bag, with the messages of rosbags and a
stand-in for rclpy."""

import ast
import importlib
import math
import sys
import tomllib
import zlib
from array import array
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers import street
from loop_streams import SEEDS

from ssrvlad_torch import SSRVLAD, Database, LoopDetector, SSRVLADConfig
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
        core.update(picture(street(seed)), number * SECOND, (number, -1.0, 0.5)).result
        for number, seed in enumerate(seeds, start)
    ]


def test_it_finds_what_the_detector_finds():
    core = live_loops.LiveLoops(CONFIG, "monday")
    core.set_labels(CAMVID)
    detector = LoopDetector(CONFIG, SSRVLAD.from_preset("default", labels_as="camvid-11"))
    expected = [
        detector.update(street(seed), f"monday/{number * SECOND:019d}", number, (number, -1.0, 0.5))
        for number, seed in enumerate(SEEDS)
    ]
    assert sum(result.accepted for result in expected) == 12
    assert seen(core) == expected


def test_without_a_table_nothing_is_seen_and_a_wrong_one_changes_nothing():
    core = live_loops.LiveLoops(CONFIG)
    with pytest.raises(ValueError, match="no table of labels has come yet"):
        seen(core, [1])
    core.set_labels(CAMVID)
    with pytest.raises(ValueError, match="unknown meaning: 'x'"):
        core.set_labels([(1, "x")])
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
    with pytest.raises(ValueError, match=r"wrong on this machine.* differ by 0\.0001"):
        live_loops.LiveLoops(CONFIG)
    live_loops.LiveLoops(CONFIG, check=False)
    live_loops.check_head(SSRVLAD(SSRVLADConfig(labels_as="camvid-11", working_size=50)))


def test_time_must_not_go_back():
    core = live_loops.LiveLoops(CONFIG)
    core.set_labels(CAMVID)
    seen(core, [1], start=5)
    with pytest.raises(ValueError, match=r"expected a stamp from 5\.0 on, got 4\.0"):
        seen(core, [1], start=4)
    with pytest.raises(ValueError, match="was there before"):
        seen(core, [1], start=5)


def test_frames_are_kept_and_gone_on_from(tmp_path, monkeypatch):
    monkeypatch.setattr(live_loops, "CHECKPOINT_FRAMES", 6)
    whole = live_loops.LiveLoops(CONFIG)
    whole.set_labels(CAMVID)
    expected = seen(whole)
    memory = tmp_path / "drive.ssrdb"
    first = live_loops.LiveLoops(CONFIG, memory=memory)
    first.set_labels(CAMVID)
    got = seen(first, SEEDS[:14])
    assert len(Database.open(memory)) == 12  # what a crash leaves
    first.save()
    second = live_loops.LiveLoops(CONFIG, memory=memory)
    second.set_labels(CAMVID)
    got += seen(second, SEEDS[14:], 14)
    assert [result.frame for result in got] == [result.frame for result in expected]
    assert got[-1].candidate == expected[-1].candidate
    second.save()
    stored = Database.open(memory)
    assert stored.load().poses[3].tolist() == [3, -1, 0.5]
    labels = second._table(street(0))
    assert stored.known()[f"drive/{0:019d}"].digest == digest(labels)


def test_a_memory_of_other_frames_is_refused(tmp_path):
    head = SSRVLAD.from_preset("default", labels_as=label_table.LABELS_AS)
    Database.create(tmp_path / "db", head.config).append(["monday/a"], head(street(0)[None]))
    with pytest.raises(ValueError, match="expected a frame <drive>/<nanoseconds>, got 'monday/a'"):
        live_loops.LiveLoops(CONFIG, memory=tmp_path / "db")


TYPES = {
    "rtabmap_msgs/msg/GlobalDescriptor": (
        "std_msgs/Header header\nint32 type\nuint8[] info\nuint8[] data\n"
    ),
    "vision_msgs/msg/LabelInfo": (
        "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold\n"
    ),
    "vision_msgs/msg/VisionClass": "uint16 class_id\nstring class_name\n",
}
"""Messages of packages beside ROS's own, as rtabmap_msgs and vision_msgs define them."""
KINDS = {
    "label_info": "vision_msgs/msg/LabelInfo",
    "odom": "nav_msgs/msg/Odometry",
    "labels": "sensor_msgs/msg/Image",
    "descriptor": "rtabmap_msgs/msg/GlobalDescriptor",
    "loops": "sensor_msgs/msg/TimeReference",
}


@pytest.fixture(scope="module")
def store():
    """The messages, with all their fields, as the library of bags knows them."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in TYPES.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


class StandInNode:
    """What `rclpy.node.Node` is asked for. It publishes as ROS does: in bytes, or not at all."""

    given: dict = {}  # noqa: RUF012
    store = None

    def __init__(self, name):
        self.name, self.published, self.said, self.listeners = name, [], [], {}

    def declare_parameter(self, name, default):
        assert type(self.given.get(name, default)) is type(default)
        return SimpleNamespace(value=self.given.get(name, default))

    def create_publisher(self, kind, topic, depth):
        assert kind.__msgtype__ == KINDS[topic]

        def publish(message):
            for field, value in vars(message).items():
                if isinstance(value, array):  # rclpy has arrays where rosbags has NumPy's
                    object.__setattr__(message, field, np.array(value))
            content = self.store.serialize_cdr(message, KINDS[topic])
            self.published.append((topic, bytes(content)))

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, callback, quality):
        assert kind.__msgtype__ == KINDS[topic]
        self.listeners[topic] = callback, quality

    def get_logger(self):
        return SimpleNamespace(error=self.said.append, warning=self.said.append)

    def destroy_node(self):
        self.said.append("destroyed")


def module(name, **contents):
    made = ModuleType(name)
    vars(made).update(contents)
    return made


@pytest.fixture
def node(monkeypatch, store):
    """The module `loop_node` with the messages of a type store and a stand-in for rclpy."""
    packages = {name.partition("/")[0] for name in store.types}
    for package in packages:
        kinds = {n.rpartition("/")[2]: t for n, t in store.types.items() if n.startswith(package)}
        monkeypatch.setitem(sys.modules, package, module(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module(f"{package}.msg", **kinds))
    monkeypatch.setattr(StandInNode, "store", store)
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


def header(types, number):
    stamp = types["builtin_interfaces/msg/Time"](sec=number, nanosec=7)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


def label_info(types, classes):
    kind = types["vision_msgs/msg/VisionClass"]
    class_map = [kind(class_id=number, class_name=name) for number, name in classes]
    return types[KINDS["label_info"]](header=header(types, 0), class_map=class_map, threshold=0.0)


def image(types, labels, number):
    fields = {**vars(picture(labels)), "header": header(types, number)}
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
    found = {
        topic: [store.deserialize_cdr(c, KINDS[t]) for t, c in running.published if t == topic]
        for topic in ("descriptor", "loops")
    }
    assert [m.header.stamp.sec for m in found["descriptor"]] == [*range(1, len(SEEDS) + 1)]
    head = SSRVLAD.from_preset("default", labels_as="camvid-11")
    for seed, message in zip(SEEDS[:3], found["descriptor"], strict=False):
        expected = head(street(seed)[None])[0].numpy()
        np.testing.assert_allclose(uncompressed(message.data.tobytes()), expected, atol=1e-6)
    core = live_loops.LiveLoops(CONFIG)
    core.set_labels(CAMVID)
    closed = [result for result in seen(core, start=1) if result.accepted]
    pairs = [(int(r.frame[-19:-9]), int(r.candidate[-19:-9])) for r in closed]
    assert len(pairs) == 12
    assert [(m.header.stamp.sec, m.time_ref.sec) for m in found["loops"]] == pairs
    assert {(m.header.stamp.nanosec, m.time_ref.nanosec) for m in found["loops"]} == {(7, 7)}
    assert {m.source for m in found["loops"]} == {"drive"}
    running.close()
    poses = Database.open(tmp_path / "db").load().poses
    np.testing.assert_allclose(poses[:2], [[1, 2, 0.25], [2, 2, 0.25]])


def test_the_node_may_be_told_that_labels_are_not_latched(node, store, monkeypatch):
    monkeypatch.setattr(StandInNode, "given", {"latched": False, "meanings": ["x=sky"]})
    running = node.LoopNode()
    assert running.listeners["label_info"][1] == (1, "volatile")
    running._on_labels(label_info(store.types, [(0, "x")]))
    assert running.said == []


def test_the_node_saves_when_it_is_interrupted(node, store, monkeypatch, tmp_path):
    def spin(running):
        running._on_labels(label_info(store.types, CAMVID))
        running._on_image(image(store.types, street(0), 1))
        raise KeyboardInterrupt

    monkeypatch.setattr(StandInNode, "given", {"memory": str(tmp_path / "db")})
    monkeypatch.setattr(node.rclpy, "spin", spin, raising=False)
    node.main()
    assert len(Database.open(tmp_path / "db")) == 1


ROS = {
    "builtin_interfaces", "nav_msgs", "rclpy", "rtabmap_msgs", "sensor_msgs", "vision_msgs"
}  # fmt: skip


def test_only_the_node_imports_ros():
    inside = PACKAGE / "ssrvlad_ros"
    for file in inside.glob("*.py"):
        imports = list(ast.walk(ast.parse(file.read_text())))
        names = {a.name for n in imports if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module or "" for n in imports if isinstance(n, ast.ImportFrom)}
        found = {name.partition(".")[0] for name in names} & ROS
        assert found == (ROS if file.stem == "loop_node" else set()), file


def test_the_package_declares_what_it_needs():
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    needs = {each.text for each in manifest.iter("exec_depend")}
    assert needs == ROS
    setup = (PACKAGE / "setup.py").read_text()
    assert f'version="{manifest.findtext("version")}"' in setup
    assert (PACKAGE / "resource" / manifest.findtext("name")).is_file()
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["name"] in setup
