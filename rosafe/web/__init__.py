"""The HTTP door: the server genomixd and the live page."""
