"""Tests of setups: reading, writing, loading, and the commands for them."""
