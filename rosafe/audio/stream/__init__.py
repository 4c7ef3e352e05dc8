"""Sound as it arrives: capture from a device, the ring of its frames, their clock time, the truth of a scene."""
