"""Tests of the clients of components."""
