"""Tests of setups: reading, writing, loading, and what starts them."""
