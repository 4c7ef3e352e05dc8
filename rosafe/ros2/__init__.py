"""The ROS 2 door: one node that captures sound, computes the tree and localizes. It imports no module of ROS 1."""

import os

# Before numpy is imported: the node multiplies small matrices, for which more threads take twice the processor time
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
