"""Invalid arguments of `rosafe.process`: a ValueError with a helpful line, before anything runs."""

from __future__ import annotations

import inspect
import tracemalloc
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.processing import process as offline
from rosafe.tree import sizes

GOOD = np.zeros((2, 100))
RATE = 16000


class Convertible:
    """An object with `__array__`."""

    def __init__(self, array: Any) -> None:
        self.array = array

    def __array__(self, *arguments: Any, **named: Any) -> Any:
        return self.array


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def run(self: Any, merge: bool) -> None:
        raise AssertionError("it went as far as that")

    monkeypatch.setattr(offline.Chain, "run", run)
    yield


def refused(match: str, *arguments: Any, **named: Any) -> None:
    with pytest.raises(ValueError, match=match) as raised:
        rosafe.process(*arguments, **named)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("signal", "match"),
    [
        (
            np.zeros((3, 100)),
            r"expected shape \(N,\) or \(1, N\) for one ear, \(2, N\) or \(N, 2\) for two, got shape \(3, 100\)",
        ),
        (np.zeros((0, 3)), r"shape \(0, 3\)"),
        (np.zeros((2, 2, 100)), "shape"),
        (np.float64(0), "^signal: expected an array of shape .*, got float64"),
        (None, "^signal: expected an array of shape .*, got NoneType"),
        ("sound.wav", r"^signal: expected an array of shape \(N,\) or \(1, N\) .*, got str"),
        ([[1.0, 2.0], [3.0]], "^signal: expected an array, got list: "),
        (np.zeros((2, 10), np.int8), "expected a float type, int32 or int16, got int8"),
        (np.zeros((2, 10), np.uint32), "got uint32"),
        (np.zeros((2, 10), bool), "got bool"),
        (np.array([["a"], ["b"]]), "got <U1"),
        (np.array([[0.0, np.nan], [0.0, 0.0]]), "NaN or infinite"),
        (np.array([[0.0, 0.0], [0.0, -np.inf]]), "NaN or infinite"),
        (np.full((2, 1), np.finfo(np.longdouble).max), "NaN or infinite"),
        (np.append(np.zeros((2, 600000)), [[0.0], [np.nan]], axis=1), "NaN or infinite"),
        (np.ma.masked_array(np.zeros((2, 10)), np.eye(2, 10)), "without a mask"),
        ([np.zeros(10), np.ma.masked_array(np.zeros(10), np.ones(10))], "without a mask"),
        (deque([np.zeros(10), np.ma.masked_array(np.zeros(10), np.ones(10))]), "without a mask"),
        (Convertible(np.ma.masked_array(np.zeros((2, 10)), np.eye(2, 10))), "without a mask"),
    ],
)
def test_signals(signal: Any, match: str) -> None:
    refused(match, signal, RATE)


@pytest.mark.parametrize("rate", [0, -1, np.nan, np.inf, 1e30, None, "16000", True, [16000], 16000j, 10**400])
def test_sample_rates(rate: Any) -> None:
    refused("^sample_rate: ", GOOD, rate)


def test_a_sample_rate_that_is_too_low_for_the_channels() -> None:
    what = "expected channels below half the sample rate, got one at 8000 Hz; use at most 7600 Hz"
    cases: tuple[dict[str, Any], ...] = ({"fb_highFreqHz": 8000.0, "fb_nChannels": 16}, {"fb_cfHz": [8000.0]})
    for values in cases:
        refused(f"{next(iter(values))}: {what}", GOOD, RATE, parameters=values)


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"fb_nErbs": 1}, r"^parameters: expected a known parameter, got 'fb_nErbs'; did you mean fb_nERBs\?"),
        ({"volume": 1}, "^parameters: expected a known parameter, got 'volume'; there are: in_doNormalize, "),
        ({"name": "x"}, "^parameters: expected a known parameter, got 'name'"),
        ({"set_rm_scailing": "_power"}, "^parameters: expected a known parameter, got "),
        ({5: 1}, "^parameters: expected a known parameter, got 5"),
        ([("fb_nERBs", 1)], "parameters: expected a dict of names and values, got list"),
        ({"fb_nERBs": 1e-3}, "fb_nERBs: expected a distance that gives at most 1024 channels, got 0.001"),
        ({"fb_lowFreqHz": 9000.0}, r"fb_lowFreqHz: expected less than fb_highFreqHz \(.* Hz\), got 9000 Hz"),
        ({"fb_cfHz": np.ma.masked}, "fb_cfHz: expected a finite number, got nan"),
        ({"pp_bRemoveDC": True, "pp_cutoffHzDC": 8000}, "pp_cutoffHzDC: expected less than half .*, got 8000 Hz"),
        ({"ild_wSizeSec": 1e-6}, "ild_wSizeSec: expected at least one sample"),
    ],
)
def test_parameters(parameters: Any, match: str) -> None:
    """tests/interface has the rules of single parameters."""
    refused(match, GOOD, RATE, parameters=parameters)


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"pi_rangeHz": [400, 80]}, r"pi_rangeHz: expected ascending numbers, got \[400.0, 80.0\]"),
        ({"fb_lowFreqHz": 5000, "fb_highFreqHz": 100}, r"fb_lowFreqHz: expected less than fb_highFreqHz \(100 Hz\), "),
        ({"ams_lowFreqHz": 500, "ams_highFreqHz": 5}, r"ams_highFreqHz: expected more than ams_lowFreqHz \(500 Hz\), "),
    ],
)
def test_descending_ranges_of_processors_that_are_not_computed(parameters: dict[str, Any], match: str) -> None:
    refused(match, GOOD, RATE, parameters=parameters, outputs="input")
    with pytest.raises(ValueError, match=f"^{match}"):
        rosafe.Stream(RATE, parameters, "input")
    changes = [(0, name, value) for name, value in parameters.items()]
    refused(match, GOOD, RATE, modifications=changes, outputs="input")
    stream = rosafe.Stream(RATE, outputs="input")
    with pytest.raises(ValueError, match=f"^{match}"):
        for name, value in parameters.items():
            stream.modify(name, value)


@pytest.mark.parametrize(
    "block_frames",
    [
        *(0, -1, 1.5, 12000.0, np.nan, None, True, "100", b"100", [], (), [100, 0], [100, -1], [100, "1"], [[1, 2]]),
        *({1: 2}, np.array(100), np.ma.array([100, 100], mask=[True, False])),
    ],
)
def test_block_sizes(block_frames: Any) -> None:
    refused(
        "^block_frames: expected a positive integer or a sequence of these, got ",
        GOOD,
        RATE,
        block_frames=block_frames,
    )


@pytest.mark.parametrize(
    ("modifications", "match"),
    [
        (5, "expected a sequence of"),
        ([5], "expected a sequence of"),
        ((0, "fb_nERBs", 2), "expected a sequence of"),
        ([(-1, "fb_nERBs", 2)], "expected a block number, got -1"),
        ([(True, "fb_nERBs", 2)], "expected a block number, got True"),
        ([(0, "fb_nErbs", 2)], "^parameters: expected a known parameter, got 'fb_nErbs'"),
        ([(0, "set_rm_scailing", "_log")], "rm_scaling: expected one of power, magnitude, got 'log'"),
        ([(99, "fb_nERBs", 0)], "fb_nERBs: expected a number above 0, at most 100, got 0"),
        ([(0, "ihc_method", "none"), (0, "ihc_method", "nothing")], "ihc_method: expected one of none, halfwave"),
        ([(9, "fb_highFreqHz", 9000.0)], "fb_highFreqHz: expected channels below half the sample rate, got one at"),
        (
            [(3, "fb_highFreqHz", 100.0), (2, "fb_lowFreqHz", 200.0)],
            r"fb_lowFreqHz: expected less than fb_highFreqHz \(100 Hz\), got 200 Hz",
        ),
    ],
)
def test_modifications(modifications: Any, match: str) -> None:
    refused(match, GOOD, RATE, block_frames=10, modifications=modifications)


@pytest.mark.parametrize(
    ("outputs", "match"),
    [
        (
            "crosscorrelation",
            r"^outputs: expected a known output, got 'crosscorrelation'; did you mean crossCorrelation\?",
        ),
        ("loudness of it", "^outputs: expected a known output, got 'loudness of it'; there are: input, preProc, "),
        (["ild", "ILD"], "^outputs: expected a known output, got 'ILD'"),
        ([5], "^outputs: expected a known output, got 5"),
        ([["ild"]], "^outputs: expected a known output, got "),
        (5, "outputs: expected a sequence of names, got 5"),
    ],
)
def test_outputs(outputs: Any, match: str) -> None:
    refused(match, GOOD, RATE, outputs=outputs)


@pytest.mark.parametrize("signal", [GOOD[0], GOOD[:1], list(GOOD[0])])
def test_binaural_outputs_of_one_ear_are_refused(signal: Any) -> None:
    refused(
        "outputs: expected representations of single ears for a signal with one ear, got ild, crossCorrelation",
        signal,
        RATE,
        outputs=CORE_REPRESENTATIONS,
    )
    refused("outputs: expected representations of single ears .*, got precedence", signal, RATE, outputs="precedence")


def test_many_blocks_take_no_memory() -> None:
    signal = np.lib.stride_tricks.as_strided(np.zeros(1, np.int16), (2, 10**9), (0, 0))
    tracemalloc.start()
    try:
        refused("outputs: expected at most", signal, RATE, block_frames=[1, 2], outputs=["input", "gammatone"])
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_tracebacks_end_at_the_call() -> None:
    wrong: tuple[dict[str, Any], ...] = ({"parameters": {"volume": 1}}, {"parameters": {"fb_cfHz": [8000.0]}})
    for named in (*wrong, {"outputs": ["x"]}):
        with pytest.raises(ValueError) as raised:
            rosafe.process(GOOD, RATE, **named)
        assert [entry.name for entry in raised.traceback] == [
            "test_tracebacks_end_at_the_call",
            "process",
        ]
        assert raised.value.__suppress_context__


def test_options_are_given_by_name() -> None:
    kinds = [p.kind.name for p in inspect.signature(rosafe.process).parameters.values()]
    assert kinds == ["POSITIONAL_OR_KEYWORD"] * 2 + ["KEYWORD_ONLY"] * 6
    with pytest.raises(TypeError, match="takes 2 positional arguments but 3 were given"):
        rosafe.process(GOOD, RATE, {"fb_nERBs": 0})  # type: ignore[call-arg]


def test_sizes_beyond_the_memory() -> None:
    text = "ild_wSizeSec: expected at most 1024 MiB, got .* MiB for 60 s of 2x31 values at 96000 Hz; take a shorter"
    refused(text, GOOD, 96000, parameters={"ild_wSizeSec": 60.0})
    refused("ild_wSizeSec: expected at most 1024 MiB", GOOD, 96000, modifications=[(0, "ild_wSizeSec", 60.0)])


def test_results_larger_than_the_free_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """If other processes use the memory, the kernel would end this process."""
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:       24684196 kB\nMemFree: 1 kB\nMemAvailable:      12000 kB\n")
    monkeypatch.setattr(sizes, "_MEMINFO", meminfo)
    sound, large = np.zeros((2, 4000)), {"cc_maxDelaySec": 1.0}
    refused(r"outputs: expected at most 12 MiB \(free on this machine\), got", sound, RATE, parameters=large)
    with pytest.raises(ValueError, match=r"^block: expected at most 12 MiB \(free on this machine\), got .*; process"):
        rosafe.Stream(RATE, large).process(sound)
    meminfo.unlink()  # the free memory is unknown
    assert sizes.available_memory() == sizes.machine_memory()


def test_large_files_are_refused_without_reading_them(tmp_path: Path) -> None:
    """All sizes are checked before the samples are read."""
    path = tmp_path / "sound.int16"
    with open(path, "wb") as file:
        file.truncate(4 * 10**12)  # a sparse file, larger than any memory
    sound = np.memmap(path, np.int16, "r").reshape(-1, 2)
    refused("outputs: expected at most .* MiB", sound, RATE)
    with pytest.raises(ValueError, match=r"^block: expected at most .* MiB"):
        rosafe.Stream(RATE).process(sound)


def test_results_larger_than_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "machine_memory", lambda: 2**24)
    sound, lags = np.zeros((2, 4000)), {"cc_maxDelaySec": 1.0}
    refused("outputs: expected at most 16 MiB .free on this machine.*; name fewer", sound, RATE, parameters=lags)
    refused("outputs: expected at most", sound, RATE, modifications=[(0, *change) for change in lags.items()])
    at_the_end = [(3, "cc_maxDelaySec", 1e-3)]  # smaller again, but too large before
    refused("outputs: expected at most", sound, RATE, parameters=lags, block_frames=1000, modifications=at_the_end)
    hidden = {
        "fb_nChannels": 500,
        "fb_highFreqHz": 4000.0,
    }  # the output of the filterbank is not stored, but computed as one block
    refused("outputs: expected at most", sound, RATE, parameters=hidden, outputs=["ild"])
    with pytest.raises(AssertionError, match="it went as far as that"):
        rosafe.process(sound, RATE, parameters=hidden, block_frames=100, outputs=["ild"])
