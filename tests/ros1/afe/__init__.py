"""Tests of the rosAFE node and its parts: wire format, audio ring, activities, requests, ports, faults."""
