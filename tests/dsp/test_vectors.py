"""The chain of stages against the reference vectors in ../shared/vectors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rosafe
from rosafe.dsp.middle_ear import middle_ear_fir
from rosafe.representations.preproc import PreProc
from tests import harness

from .bare import FloatArray, cut

CASES = (
    "P01_noise_default",
    "P02_harmonic_nch16",
    "P03_clicks_cfHz",
    "P04_chirp_irregular",
    "P05_silence_burst_agc",
    "P06_dc_preemph",
    "P07_level_square_sqrtwin",
    "P08_middleear_jepsen",
    "P09_ihc_joergensen",
    "P10_modify_running",
)


def load(name: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    cases = {case["name"]: case for case in json.loads(harness.shared("vectors", "manifest.json").read_text())}
    with np.load(harness.shared("vectors", cases[name]["file"])) as arrays:
        return cases[name], dict(arrays)


def parameters(case: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters of a case that differ from the defaults of the interface table."""
    return {"pp_bUnityComp": case["all_params"]["pp_bUnityComp"], **case["params"]}


@pytest.mark.parametrize("name", CASES)
def test_reference_vectors(name: str) -> None:
    """Through the tree, with parameter changes."""
    case, expected = load(name)
    options = {"parameters": parameters(case), "block_frames": case["chunks"], "modifications": case["mods"]}
    assert_reference(case, rosafe.process(expected["signal"], case["fs"], **options), expected)


def assert_reference(
    case: dict[str, Any], results: Mapping[str, NDArray[Any]], expected: Mapping[str, NDArray[Any]]
) -> None:
    """Compare complete outputs of all stages, `fb_cfHz` and `cc_lags` with the samples in the reference."""
    got = dict(results)
    times, channels = expected["time_idx"], expected["chan_idx"]
    got.update({kind: got[kind][:, times] for kind in ("input", "preProc")})
    got.update({kind: got[kind][:, channels][..., times] for kind in ("gammatone", "ihc")})
    got["crosscorrelation"] = got.pop("crossCorrelation")[channels]

    def error(kind: str) -> FloatArray:
        assert got[kind].shape == expected[kind].shape
        return np.abs(got[kind] - expected[kind])

    np.testing.assert_allclose(got["fb_cfHz"], expected["cfHz"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(got["cc_lags"], expected["lags"], rtol=1e-12, atol=1e-18)

    # the high-pass of the reference is less accurate
    has_dc_filter = case["params"].get("pp_bRemoveDC", False)
    assert error("input").max() == 0
    assert error("preProc").max() <= (1e-5 if has_dc_filter else 1e-13) * np.abs(expected["preProc"]).max()
    peak = np.abs(expected["gammatone"]).max(axis=-1, keepdims=True)
    assert (error("gammatone") / peak).max() <= (2e-5 if has_dc_filter else 2e-6)
    if case["name"] == "P09_ihc_joergensen":
        check_envelope_case(got, expected)
        return
    is_squared = case["name"].startswith("P07")
    peak = np.abs(expected["ihc"]).max(axis=-1, keepdims=True)
    assert (error("ihc") / peak).max() <= (2e-5 if has_dc_filter else 5e-6 if is_squared else 2e-6)
    assert error("ratemap").max() <= 1e-6 * expected["ratemap"].max()
    assert error("ild").max() <= 1e-3
    assert error("crosscorrelation").max() <= 1e-4


def check_envelope_case(got: Mapping[str, FloatArray], expected: Mapping[str, NDArray[Any]]) -> None:
    """The envelope in the reference is from an FFT of the whole signal: compare strong channels, away from the ends."""
    inside = (expected["time_idx"] >= 1000) & (expected["time_idx"] < 17640 - 1000)
    error = np.abs(got["ihc"] - expected["ihc"])[..., inside] / expected["ihc"].max(axis=-1)[..., np.newaxis]
    level = 20 * np.log10(got["gammatone"].std(axis=-1))
    level -= level.max()
    assert (level > -40).sum() >= 5
    assert error[level > -40].max() < 0.06
    assert (level > -20).sum() == 4
    assert error[level > -20].max() < 5e-4
    strong = [1, 2, 3, 4]  # of all six channels: within 20 dB of the strongest
    assert np.abs(got["ild"] - expected["ild"])[strong, 3:-3].max() < 1e-3
    assert np.abs(got["crosscorrelation"] - expected["crosscorrelation"])[1:3, :, 3:-3].max() < 1e-5
    ratemap = np.abs(got["ratemap"] - expected["ratemap"])[:, strong, 3:-3]
    assert (ratemap / expected["ratemap"].max(axis=-1)[:, strong, np.newaxis]).max() < 1e-3


def test_stage_by_stage() -> None:
    """With the input from the reference, errors of previous stages have no effect."""
    case, expected = load("P08_middleear_jepsen")
    fir = middle_ear_fir("jepsen", case["fs"], unity=False)
    np.testing.assert_allclose(fir, expected["me_fir"], rtol=0, atol=1e-14 * np.abs(fir).max())
    case, expected = load("P05_silence_burst_agc")
    stage = PreProc(case["fs"], **{k: v for k, v in case["params"].items() if k.startswith("pp_")})
    signal = expected["signal"] / (2**31 - 1)
    got = np.concatenate([stage.process(block) for block in cut(signal, case["chunks"])], axis=-1)
    np.testing.assert_allclose(got[:, expected["time_idx"]], expected["preProc"], rtol=1e-14, atol=1e-15)
