"""Plots, tables and xarray datasets of results; direction estimates. Independent of ROS."""
