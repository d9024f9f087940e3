"""ROS 2 bags without ROS: sound, detections and odometry in, world-states out."""
