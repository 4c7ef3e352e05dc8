"""The ROS 1 door: the nodes bass, rosAFE and localizer, and clients of components."""
