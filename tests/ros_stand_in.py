"""The messages of ROS 2 by rosbags, and a stand-in for rclpy."""

from array import array
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

PACKAGE = Path(__file__).parents[1] / "export" / "ros2"
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
    "image": "sensor_msgs/msg/Image",
    "descriptor": "rtabmap_msgs/msg/GlobalDescriptor",
    "loops": "sensor_msgs/msg/TimeReference",
    "results": "std_msgs/msg/String",
    "answers": "std_msgs/msg/String",
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


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

    def sent(self, topic):
        """What was published, by the fields of its message."""
        kind = KINDS[topic]
        return [self.store.deserialize_cdr(c, kind) for t, c in self.published if t == topic]


def module(name, **contents):
    made = ModuleType(name)
    vars(made).update(contents)
    return made
