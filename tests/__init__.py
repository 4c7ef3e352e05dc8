"""The test suite: one folder per area, and a common harness for tests with ROS."""
