"""The ROS 2 node: messages to `LiveLoops` and back, nothing else."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_msgs.msg import String
from vision_msgs.msg import LabelInfo

from ssrvlad_torch.loops.config import LoopConfig

from .live_loops import LiveLoops, heading, meanings_of


class LoopNode(Node):
    """Subscribes to ``labels``, ``label_info`` and ``odom``; publishes ``loops``.

    Its parameters are the settings of `LoopConfig`, and ``sequence``, ``memory``, ``preset``,
    ``meanings`` (see `LiveLoops`) and ``latched``: whether ``label_info`` is published once, with
    durability "transient local".
    """

    def __init__(self) -> None:
        super().__init__("ssrvlad_loops")
        settings = dataclasses.asdict(LoopConfig())
        config = LoopConfig(**{name: self._given(name, value) for name, value in settings.items()})
        memory, preset = self._given("memory", ""), self._given("preset", "")
        self._loops = LiveLoops(
            config,
            self._given("sequence", "drive"),
            meanings_of(self._given("meanings", [""])),
            Path(memory) if memory else None,
            preset or None,
        )
        self._pose = None
        once = DurabilityPolicy.TRANSIENT_LOCAL
        durability = once if self._given("latched", True) else DurabilityPolicy.VOLATILE
        self._publisher = self.create_publisher(String, "loops", 10)
        self.create_subscription(
            LabelInfo, "label_info", self._on_labels, QoSProfile(depth=1, durability=durability)
        )
        self.create_subscription(Odometry, "odom", self._on_odometry, 10)
        self.create_subscription(Image, "labels", self._on_image, qos_profile_sensor_data)

    def close(self) -> None:
        """Saves what was seen."""
        self._loops.save()

    def _given(self, name, default):
        return self.declare_parameter(name, default).value

    def _on_labels(self, message: LabelInfo) -> None:
        try:
            self._loops.learn_labels((each.class_id, each.class_name) for each in message.class_map)
        except ValueError as error:
            self.get_logger().error(str(error))

    def _on_odometry(self, message: Odometry) -> None:
        pose = message.pose.pose
        self._pose = pose.position.x, pose.position.y, heading(pose.orientation)

    def _on_image(self, message: Image) -> None:
        stamp = message.header.stamp
        try:
            found = self._loops.see(message, stamp.sec * 10**9 + stamp.nanosec, self._pose)
        except (ValueError, OSError) as error:
            self.get_logger().warning(f"frame skipped: {error}")
        else:
            self._publisher.publish(String(data=found))


def main() -> None:
    """Runs the node until it is interrupted."""
    rclpy.init()
    node = LoopNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()
