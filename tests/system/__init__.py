"""Tests of files and terminals."""
