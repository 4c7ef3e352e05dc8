"""Representations that are shown as levels: dB per factor of 10, which is 10 for powers and 20 for amplitudes."""

from __future__ import annotations

LEVELS = {"gammatone": 20.0, "ihc": 20.0, "ratemap": 10.0, "amsFeatures": 20.0}
