"""Sound: devices, scenes and sound files, without ROS."""
