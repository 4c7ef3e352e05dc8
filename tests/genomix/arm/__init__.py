"""A small GenoM component that is not ours: its ROS package `arm`, generated as catkin would, and its server."""
