"""Tests of plots, tables and datasets."""
