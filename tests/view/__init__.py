"""Tests of what a person gets to see."""
