"""Directions of sounds: heads, scenes with known truth, direction models, localization and tracking. No ROS."""
