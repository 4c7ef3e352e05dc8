"""ROS transport of a node: servers with limits, registration at the master, publishers, self-check."""
