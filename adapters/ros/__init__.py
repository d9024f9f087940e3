"""ROS 2 bags without ROS: read sound, detections and odometry, write world-states."""
