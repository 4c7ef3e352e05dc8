"""Tests of the demonstration, the README and the documents."""
