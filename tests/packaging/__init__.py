"""Tests of installation and builds (messages, kernels, catkin, pip), of the environment, and of linters."""
