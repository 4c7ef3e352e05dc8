"""Tests of the representations that the original does not have: results, changes, errors."""
