"""Tests of the rosAFE node and of what it is made of: wire format, audio ring, activities, requests, ports, faults."""
