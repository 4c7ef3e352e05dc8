"""Sound files, audio in rosbags and messages, and a model of the head. Imports neither ROS nor the tree."""
