"""The HTTP server `genomixd`: components of the ROS graph for clients that speak HTTP, such as Tcl and MATLAB."""
