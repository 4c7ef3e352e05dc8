"""Tests of heads, scenes, direction models, localization and tracking."""
