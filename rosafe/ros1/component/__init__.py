"""A component on the ROS graph, as GenoM generates them: requests, ports, wire format, messages, start-up."""
