"""Not run in ROS itself: the tests run it over a bag, between stand-ins for `rclpy`.

The ROS 2 node: passes messages to `LiveLoops` and publishes its results.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from array import array
from pathlib import Path

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
)
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rtabmap_msgs.msg import GlobalDescriptor
from sensor_msgs.msg import Image, TimeReference
from std_msgs.msg import Header, String
from vision_msgs.msg import LabelInfo

from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.search.answers import Answer

from .live_loops import LiveLoops, as_rtabmap, heading, meanings_of, open_tracker, source_of
from .place_model import PlaceModel

_SECOND = 10**9
_OF_PYTHON = 1
"""The type that RTAB-Map gives the descriptors of its own Python scripts."""


class LoopNode(Node):
    """Reads ``image``, or ``labels`` and ``label_info``, and ``odom``; publishes ``descriptor``,
    ``loops`` and ``results``, and in a known map ``answers`` and ``pose``.

    Its parameters are the settings of `LoopConfig`; ``sequence``, ``memory``, ``preset``,
    ``meanings``, ``check`` (see `LiveLoops`); ``model`` and ``features`` (see `PlaceModel`): with a
    model it reads ``image``; ``latched``: whether ``label_info`` is published once, with
    durability "transient local"; ``map`` and ``delay`` (see `open_tracker`); ``min_confidence`` of
    a pose that is published, the ``map_frame`` that it is in, and what a right one errs by,
    ``sigma_metres`` and ``sigma_radians``.
    """

    def __init__(self) -> None:
        super().__init__("ssrvlad_loops")
        settings = dataclasses.asdict(LoopConfig())
        config = LoopConfig(
            **{name: self._parameter(name, value) for name, value in settings.items()}
        )
        memory, preset = self._parameter("memory", ""), self._parameter("preset", "")
        check, path = self._parameter("check", True), self._parameter("model", "")
        features = self._parameter("features", True)
        model = PlaceModel(Path(path), features, check) if path else None
        town, delay = self._parameter("map", ""), self._parameter("delay", 0)
        self._least = self._parameter("min_confidence", 0.9)
        self._map_frame = self._parameter("map_frame", "map")
        metres = self._parameter("sigma_metres", 5.0)
        radians = self._parameter("sigma_radians", 0.5)
        self._covariance = np.zeros(36)
        self._covariance[[0, 7, 35]] = metres**2, metres**2, radians**2
        self._loops = LiveLoops(
            config,
            self._parameter("sequence", "drive"),
            meanings_of(self._parameter("meanings", [""])),
            memory or None,
            preset or None,
            check,
            model,
            open_tracker(town, model, delay) if town else None,
        )
        self._pose = None
        latched = self._parameter("latched", True)
        self._descriptors = self.create_publisher(GlobalDescriptor, "descriptor", 10)
        self._closures = self.create_publisher(TimeReference, "loops", 10)
        self._results = self.create_publisher(String, "results", 10)
        self._answers = self.create_publisher(String, "answers", 10)
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.create_subscription(Odometry, "odom", self._on_odometry, 10)
        topic = "image" if model else "labels"
        self.create_subscription(Image, topic, self._on_image, qos_profile_sensor_data)
        if model is None:
            once = DurabilityPolicy.TRANSIENT_LOCAL
            durability = once if latched else DurabilityPolicy.VOLATILE
            quality = QoSProfile(depth=1, durability=durability)
            self.create_subscription(LabelInfo, "label_info", self._on_labels, quality)

    def close(self) -> None:
        """Saves the frames."""
        self._loops.save()

    def _parameter(self, name, default):
        return self.declare_parameter(name, default).value

    def _on_labels(self, message: LabelInfo) -> None:
        try:
            self._loops.set_labels(
                (entry.class_id, entry.class_name) for entry in message.class_map
            )
        except ValueError as error:
            self.get_logger().error(str(error))

    def _on_odometry(self, message: Odometry) -> None:
        pose = message.pose.pose
        self._pose = pose.position.x, pose.position.y, heading(pose.orientation)

    def _on_image(self, message: Image) -> None:
        header = message.header
        try:
            nanoseconds = header.stamp.sec * _SECOND + header.stamp.nanosec
            update = self._loops.update(message, nanoseconds, self._pose)
        except ValueError as error:
            self.get_logger().warning(f"frame skipped: {error}")
            return
        result, descriptor = update.result, update.descriptor
        closed = source_of(result.candidate) if result.accepted else None
        if update.unsaved:
            self.get_logger().error(f"the memory cannot be written: {update.unsaved}")
        data = array("B", as_rtabmap(descriptor))
        self._descriptors.publish(
            GlobalDescriptor(header=header, type=_OF_PYTHON, info=array("B"), data=data)
        )
        self._results.publish(String(data=json.dumps(result.as_json())))
        if closed:
            source, nanoseconds = closed
            stamp = _time(nanoseconds)
            self._closures.publish(TimeReference(header=header, time_ref=stamp, source=source))
        if update.answer:
            self._localise(update.answer)

    def _localise(self, answer: Answer) -> None:
        """Publishes an answer, and if it is sure enough and its place has a pose that too, with the
        stamp of the image."""
        self._answers.publish(String(data=json.dumps(answer.as_json())))
        if not answer.candidates or answer.confidence < self._least:
            return
        x, y, angle = answer.candidates[0].pose
        if math.isnan(x + y + angle):
            return
        rotation = Quaternion(x=0.0, y=0.0, z=math.sin(angle / 2), w=math.cos(angle / 2))
        place = Pose(position=Point(x=x, y=y, z=0.0), orientation=rotation)
        pose = PoseWithCovariance(pose=place, covariance=self._covariance)
        header = Header(stamp=_time(source_of(answer.query)[1]), frame_id=self._map_frame)
        self._poses.publish(PoseWithCovarianceStamped(header=header, pose=pose))


def _time(nanoseconds: int) -> Time:
    return Time(sec=nanoseconds // _SECOND, nanosec=nanoseconds % _SECOND)


def main() -> None:
    """Runs the node until it is interrupted or terminated; wrong parameters, and a memory that
    cannot be written at the end, are one line and exit code 1."""
    rclpy.init()
    try:
        node = LoopNode()
    except (ValueError, OSError, ImportError) as error:
        rclpy.try_shutdown()
        sys.exit(f"ssrvlad_loops: {error}")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        try:
            node.close()
        except (ValueError, OSError) as error:
            sys.exit(f"ssrvlad_loops: {error}")
        finally:
            node.destroy_node()
        rclpy.try_shutdown()
