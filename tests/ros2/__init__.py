"""Tests of the ROS 2 node, its packages, launch file and command, with a real ROS 2."""
