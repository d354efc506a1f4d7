"""Starts the node with its parameters: ros2 launch lumidock_ros lumidock.launch.py station:=dock.yaml image:=/TOPIC."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

FILES = {"station": "the dock's station file", "camera": "calibration, else camera_info", "vehicle": "vehicle file"}
TOPICS = {"image": "/front/image_raw", "camera_info": "/front/camera_info"}


def generate_launch_description() -> LaunchDescription:
    """The node, its files and its topics."""
    share = Path(get_package_share_directory("lumidock_ros"))
    files = [DeclareLaunchArgument(name, default_value="", description=text) for name, text in FILES.items()]
    topics = [DeclareLaunchArgument(name, default_value=topic) for name, topic in TOPICS.items()]
    node = Node(
        package="lumidock_ros",
        executable="node",
        name="lumidock",
        output="screen",
        parameters=[str(share / "config" / "lumidock.yaml"), {name: LaunchConfiguration(name) for name in FILES}],
        remappings=[
            ("image", LaunchConfiguration("image")),
            ("image/compressed", [LaunchConfiguration("image"), "/compressed"]),
            ("camera_info", LaunchConfiguration("camera_info")),
        ],
    )
    return LaunchDescription([*files, *topics, node])
