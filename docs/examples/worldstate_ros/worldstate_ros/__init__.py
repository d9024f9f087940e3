"""A node of ROS 2 around worldstate."""
