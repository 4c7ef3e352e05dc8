"""The tree without ROS, as fast as it goes: signals in memory, and sound files of any length."""
