"""The ROS 2 door: one node that captures sound, computes the tree and localizes. It imports no module of ROS 1."""
