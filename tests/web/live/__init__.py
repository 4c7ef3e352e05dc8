"""Tests of the live page: its pictures, its server, and the page in a browser."""
