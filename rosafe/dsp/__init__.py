"""Code shared by representations: frames, windows, the ERB scale, filters, numeric limits, the base class of stages.

It depends on numpy and scipy only, not on ROS, threads or service names. Each stage accepts blocks of any length, and
its output does not depend on the block boundaries (bit-identical with kernels, to 1e-12 without; the start of gain
control is the only exception). Finite input gives finite output.

Modules use `import scipy`, which loads `scipy.signal` at its first use: that import takes longer than all others.
"""
