"""Which representations are shown as levels: powers and amplitudes, with so many dB for a factor of 10."""

from __future__ import annotations

LEVELS = {"gammatone": 20.0, "ihc": 20.0, "ratemap": 10.0, "amsFeatures": 20.0}
