"""Tests of the capture node and its sources."""
