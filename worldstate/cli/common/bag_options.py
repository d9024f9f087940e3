"""Options of commands that read or write bags of ROS 2."""

import argparse
from typing import TYPE_CHECKING

from .command import add_choice

if TYPE_CHECKING:
    from worldstate.adapters.ros.bag_input import BagTopics


def add_topic_options(parser: argparse.ArgumentParser) -> None:
    """Declare --detections-topic and --odometry-topic; --audio-topic stands with INPUT."""
    add = parser.add_argument_group("bag of ROS 2").add_argument
    only = "(default: the only one of its type)"
    add("--detections-topic", metavar="TOPIC", help=f"vision_msgs/Detection2DArray of the camera {only}")
    add("--odometry-topic", metavar="TOPIC", help=f"nav_msgs/Odometry of the ego {only}")


def add_storage_option(parser: argparse.ArgumentParser) -> None:
    """Declare --ros-storage."""
    add_choice(parser, "--ros-storage", "storage of the bag that is written", "mcap", "sqlite3")


def topics_of(arguments: argparse.Namespace) -> "BagTopics":
    """Return the topics that were asked for."""
    from worldstate.adapters.ros.bag_input import BagTopics

    return BagTopics(arguments.audio_topic, arguments.detections_topic, arguments.odometry_topic)
