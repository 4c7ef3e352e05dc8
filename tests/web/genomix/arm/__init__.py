"""A small GenoM component of another project: its ROS package `arm`, generated like by catkin, and its server."""
