"""The number of audio frames in a block: the default everywhere, and the maximum that `InputProc` accepts."""

DEFAULT_FRAMES_PER_BLOCK = 12000
MAX_FRAMES_PER_BLOCK = 10_000_000
