"""Tests of results and their files."""
