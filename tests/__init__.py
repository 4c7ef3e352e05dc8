"""The test suite: one folder per area, and the harness that the areas with ROS share."""
