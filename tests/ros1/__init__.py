"""Tests of the ROS 1 nodes and their clients."""
