"""The processor tree: state machine, tokens, windows and parameter changes between blocks. Knows no ROS."""
