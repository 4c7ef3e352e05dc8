"""Tests of devices and sound files."""
