"""Start the node: `ros2 launch worldstate_ros worldstate.launch.py params:=mine.yaml audio:=/roof/audio`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = {
    "audio": "/microphones/audio",
    "detections": "/camera/detections",
    "odometry": "/odometry",
    "~/objects": "/perception/object_recognition/objects",
}


def generate_launch_description() -> LaunchDescription:
    """Return the node with its parameters and topics."""
    share = Path(get_package_share_directory("worldstate_ros"))
    asked = [
        DeclareLaunchArgument("params", default_value=str(share / "config" / "worldstate.yaml")),
        *(DeclareLaunchArgument(name.strip("~/"), default_value=topic) for name, topic in TOPICS.items()),
    ]
    node = Node(
        package="worldstate_ros",
        executable="listener",
        name="worldstate",
        output="screen",
        parameters=[LaunchConfiguration("params")],
        remappings=[(name, LaunchConfiguration(name.strip("~/"))) for name in TOPICS],
    )
    return LaunchDescription([*asked, node])
