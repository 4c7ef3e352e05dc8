"""The procedure of docs/directions.md that measures the latency of a sound card with a turning head."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rosafe
from rosafe.localization import angles
from tests.localization.conftest import RATE, modulated

SPEED, TURN = 60.0, 1.5  # degrees/s, s in one direction
TALKER = 10.0
DELAY = 0.05  # s


@pytest.mark.exploration
def test_latency_from_the_azimuths_of_a_turning_head(kemar_model: Path, kemar: rosafe.Head) -> None:
    points = [[TURN * number, SPEED * TURN * (number % 2) - 45.0] for number in range(7)]
    times = np.arange(round(points[-1][0] * RATE)) / RATE
    yaw = np.interp(times, *np.transpose(points))
    ears = kemar.render(modulated(points[-1][0], 8), RATE, angles.wrap(TALKER - yaw))
    late = [[time + DELAY, degrees] for time, degrees in points]  # the sound has later stamps than it was heard
    early = [[time - DELAY, degrees] for time, degrees in points]
    measured = {}
    for name, used in (("uncorrected", early), ("corrected", points), ("twice", late)):
        tracks = rosafe.localize(ears, RATE, kemar_model, head_yaw=used)["tracks"]
        track = max(tracks, key=lambda one: len(one["time"]))
        assert np.median(np.abs(angles.difference(track["azimuth"], TALKER))) < 6
        phase = (track["time"] / TURN) % 2
        error = angles.difference(track["azimuth"], TALKER)
        left, right = (float(np.mean(error[(phase > begin + 0.5) & (phase < begin + 1)])) for begin in (0, 1))
        measured[name] = (left - right) / (2 * SPEED)
    # The grid of 5 degrees makes the size of a difference inexact, but neither its sign nor its zero.
    assert DELAY / 2 < measured["uncorrected"] < 2 * DELAY
    assert -2 * DELAY < measured["twice"] < -DELAY / 2
    assert abs(measured["corrected"]) < DELAY / 4
