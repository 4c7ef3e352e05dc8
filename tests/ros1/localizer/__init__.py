"""Tests of the localizer node: real masters and nodes, scenes with known truth."""
