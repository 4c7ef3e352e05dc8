"""What the representations share: frames, windows, the ERB scale, filters, guards, and the base class of all stages.

Needs numpy and scipy only; knows no ROS, no threads and no names of services. Every stage takes blocks of any length
and gives the same numbers however the signal is cut into blocks (to the last bit with kernels, 1e-12 without; where
gain control starts is the one exception). Finite input gives finite output.

Modules here `import scipy`, which loads `scipy.signal` at its first use: that takes longer than all the rest.
"""
