"""Tests of what turns a clone into something that runs: generation, environment, installation, build, lint."""
