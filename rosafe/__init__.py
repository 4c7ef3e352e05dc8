"""rosAFE: the Two!Ears auditory front-end for ROS 1, in Python."""

__version__ = "0.1.0"
