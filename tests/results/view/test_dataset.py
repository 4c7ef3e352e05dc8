"""`rosafe.to_xarray`: names, values and units of all axes of every kind."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.interface import KINDS

xarray = pytest.importorskip("xarray", reason="xarray is not installed: scripts/install --tests")

RATE = 16000
AUDIO = 0.1 * np.random.default_rng(4).standard_normal((2, 8000))


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    values = {"fb_nChannels": 8, "ild_hSizeSec": 0.005}
    return rosafe.process(AUDIO, RATE, parameters=values, outputs=list(KINDS))


def test_values_are_selected_by_coordinates(result: dict[str, Any]) -> None:
    data = rosafe.to_xarray(result)
    names = [name for kind in KINDS.values() for name in kind.outputs]
    assert list(data.data_vars) == names
    for kind in KINDS.values():
        for name, part in kind.outputs.items():
            np.testing.assert_array_equal(data[name].values, result[name])
            assert data[name].attrs["units"] == part.unit
            assert [str(dim).partition("_")[0] for dim in data[name].dims] == list(part.axes)
            np.testing.assert_array_equal(data[name][data[name].dims[-1]], result[f"{kind.kind}_time"])
    assert data.ratemap.dims == ("ear", "channel", "time_ratemap"), "the first output with frames has other times"
    level = data.ratemap.sel(ear="right").sel(channel=1000, time_ratemap=0.1, method="nearest")
    channel, frame = np.abs(result["fb_cfHz"] - 1000).argmin(), np.abs(result["ratemap_time"] - 0.1).argmin()
    assert float(level) == result["ratemap"][1, channel, frame]
    assert data.channel.attrs["units"] == "Hz" and data.time.attrs["units"] == "s"


def test_different_axes_have_different_names(result: dict[str, Any]) -> None:
    data = rosafe.to_xarray(result)
    assert data.input.dims == ("ear", "time_samples") and data.ild.dims == ("channel", "time")
    assert data.crossCorrelation.dims[-1] == data.ratemap.dims[-1] == "time_ratemap"
    alone = rosafe.to_xarray(rosafe.process(AUDIO, RATE, outputs="preProc"))
    assert alone.preProc.dims == ("ear", "time")
    np.testing.assert_array_equal(data[data.crossCorrelation.dims[1]], result["cc_lags"])
    np.testing.assert_array_equal(data[data.autocorrelation.dims[2]], result["ac_lags"])
    assert list(data[data.spectralFeatures.dims[1]].values) == list(result["sf_requests"])


def test_one_ear() -> None:
    data = rosafe.to_xarray(rosafe.process(AUDIO[0], RATE, parameters={"fb_nChannels": 4}, outputs="ratemap"))
    assert list(data.ear.values) == ["left"] and data.ratemap.shape == (1, 4, 49)


def test_errors(result: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="at least one output"):
        rosafe.to_xarray({"fb_cfHz": [1.0]})
    with pytest.raises(ValueError, match="sample_rate"):
        rosafe.to_xarray({"input": AUDIO})
    assert rosafe.to_xarray({"input": AUDIO}, sample_rate=RATE).time[-1] == 7999 / RATE
    monkeypatch.setitem(sys.modules, "xarray", None)  # type: ignore[misc]
    with pytest.raises(
        ModuleNotFoundError, match="xarray is not installed; apt install python3-xarray, or pip install"
    ):
        rosafe.to_xarray(result)
