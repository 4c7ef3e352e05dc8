"""ROS clients of components: the graph, TCPROS connections, actions, services and setups."""
