"""Sound itself: files of it, and how a head changes it. No ROS, no processors."""
