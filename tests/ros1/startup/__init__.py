"""Tests of starting and ending nodes from the shell."""
