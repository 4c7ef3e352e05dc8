"""Any component on the ROS graph, as GenoM makes them: requests, ports, wire format, messages, start-up."""
