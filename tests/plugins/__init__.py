"""Tests of representations of somebody else's."""
