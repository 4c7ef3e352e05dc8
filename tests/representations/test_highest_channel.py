"""The highest channel if it is not given: 8000 Hz, or a fraction of the sample rate."""

from __future__ import annotations

from typing import Any

import pytest

from rosafe.representations.gammatone import Filterbank


@pytest.mark.parametrize(
    ("rate", "values", "highest"),
    [
        (16000, {"fb_nChannels": 16}, 7600.0),
        (16000, {"fb_nChannels": 16, "fb_type": "drnl"}, 7600.0),
        (16000, {"fb_nChannels": 16, "fb_highFreqHz": 7000.0}, 7000.0),
        (16000, {}, 8000.0),  # the default channels end below it
        (8000, {}, 3800.0),
        (8000, {"fb_nERBs": 0.5, "fb_lowFreqHz": 200.0}, 3800.0),
        (44100, {"fb_nChannels": 16}, 8000.0),
        (16000.001, {"fb_nChannels": 16}, 8000.0),
    ],
)
def test_it_follows_the_sample_rate(rate: float, values: dict[str, Any], highest: float) -> None:
    reported = Filterbank(rate, **values).parameters
    assert reported["fb_highFreqHz"] == highest
    assert reported["fb_cfHz"] == Filterbank(rate, **{**values, "fb_highFreqHz": highest}).parameters["fb_cfHz"]
    assert max(reported["fb_cfHz"]) < rate / 2


def test_it_follows_updates_until_it_is_given() -> None:
    stage = Filterbank(16000)
    stage.configure(fb_nChannels=5)
    assert stage.parameters["fb_highFreqHz"] == 7600.0
    with pytest.raises(ValueError, match=r"fb_highFreqHz: expected .* got one at 8000 Hz; use at most 7600 Hz"):
        stage.configure(fb_highFreqHz=8000.0)
    stage.configure(fb_nERBs=1.0)
    assert stage.parameters["fb_highFreqHz"] == 8000.0
    stage.configure(fb_highFreqHz=7999.0)
    stage.configure(fb_nChannels=5)
    assert stage.parameters["fb_highFreqHz"] == stage.parameters["fb_cfHz"][-1] == 7999.0


def test_a_rejected_value_does_not_count_as_given() -> None:
    stage = Filterbank(8000)
    with pytest.raises(ValueError, match="use at most 3800 Hz"):
        stage.configure(fb_highFreqHz=5000.0)
    stage.configure(fb_nChannels=5)
    assert stage.parameters["fb_highFreqHz"] == 3800.0
