"""Tests of each representation beyond the original's seven: numbers, changes, refusals."""
