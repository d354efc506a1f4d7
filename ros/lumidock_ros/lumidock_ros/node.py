"""The ROS 2 node: hands serialized messages to the bridge and publishes what it answers."""

from __future__ import annotations

from dataclasses import fields

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message

from lumidock.errors import LumidockError
from lumidock_ros.bridge import Bridge, Options

# the newest picture only: what came while the one before was localized is dropped, never queued
NEWEST = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
LASTING = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
WARN_S = 5.0  # between two lines about the same calibration


class LumidockNode(Node):
    """Subscribes to `image` (or `image/compressed`) and `camera_info`; publishes the topics of lumidock."""

    def __init__(self) -> None:
        super().__init__("lumidock")
        for option in fields(Options):
            self.declare_parameter(option.name, "" if option.name == "station" else option.default)
        self.declare_parameter("compressed", False)
        options = Options(**{option.name: self.get_parameter(option.name).value for option in fields(Options)})
        compressed = bool(self.get_parameter("compressed").value)
        self.kind = "sensor_msgs/msg/CompressedImage" if compressed else "sensor_msgs/msg/Image"
        topic = "image/compressed" if compressed else "image"
        self.bridge = Bridge.of(options, self.resolve_topic_name("image"))
        self.publishers_of = {
            topic: self.create_publisher(get_message(kind), topic, LASTING if topic == "/tf_static" else 10)
            for topic, kind in self.bridge.topics().items()
        }
        self.create_subscription(get_message(self.kind), topic, self.on_image, NEWEST, raw=True)
        info = get_message("sensor_msgs/msg/CameraInfo")
        self.info = self.create_subscription(info, "camera_info", self.on_info, NEWEST, raw=True)

    def on_info(self, data: bytes) -> None:
        """Take the calibration once."""
        try:
            for note in self.bridge.info(bytes(data)):
                self.get_logger().warning(note)
        except LumidockError as error:
            self.get_logger().error(str(error), throttle_duration_sec=WARN_S)

    def on_image(self, data: bytes) -> None:
        """Localize a picture and publish what there is to say of it."""
        if self.bridge.camera is None:
            self.get_logger().info("waiting for camera_info; or give a camera file", throttle_duration_sec=WARN_S)
        arrival_ns = self.get_clock().now().nanoseconds
        for message in self.bridge.image(self.kind, bytes(data), arrival_ns):
            self.publishers_of[message.topic].publish(message.data)


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        rclpy.spin(LumidockNode())
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()
