"""Tests of the interface: wire types, md5 sums, and the one table that states them."""
