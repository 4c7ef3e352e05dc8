"""What `rosafe.process` refuses: a ValueError with a line that helps, before anything runs."""

from __future__ import annotations

import inspect
import itertools
import tracemalloc
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.offline import memory
from rosafe.offline import process as offline
from rosafe.tree import sizes

GOOD = np.zeros((2, 100))
RATE = 16000


class Convertible:
    """An object that numpy converts by its method."""

    def __init__(self, array: Any) -> None:
        self.array = array

    def __array__(self, *arguments: Any, **named: Any) -> Any:
        return self.array


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def run(self: Any, together: bool) -> None:
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
            r"shape \(3, 100\); wanted is \(N,\) or \(1, N\) for one ear, \(2, N\) or \(N, 2\) for two",
        ),
        (np.zeros((100, 1)), r"shape \(100, 1\)"),
        (np.zeros((0, 3)), r"shape \(0, 3\)"),
        (np.zeros((2, 2, 100)), "shape"),
        (np.float64(0), "signal is no array, but float64"),
        (None, "signal is no array, but NoneType"),
        ("sound.wav", r"signal is no array, but str; wanted is \(N,\) or \(1, N\)"),
        ([[1.0, 2.0], [3.0]], "signal is no array"),
        (np.zeros((2, 10), np.int8), "type int8, wanted is a float type, int32 or int16"),
        (np.zeros((2, 10), np.int64), "type int64"),
        (np.zeros((2, 10), np.uint32), "type uint32"),
        (np.zeros((2, 10), bool), "type bool"),
        (np.zeros((2, 10), complex), "type complex128"),
        (np.zeros((2, 10), object), "type object"),
        (np.array([["a"], ["b"]]), "type <U1"),
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
    what = "a channel at 8000 Hz is not below half the sample rate; 7600 Hz would do"
    cases: tuple[dict[str, Any], ...] = ({"fb_highFreqHz": 8000.0, "fb_nChannels": 16}, {"fb_cfHz": [8000.0]})
    for values in cases:
        refused(f"{next(iter(values))}: {what}", GOOD, RATE, parameters=values)


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"fb_nErbs": 1}, r"unknown parameter 'fb_nErbs'; did you mean fb_nERBs\?"),
        ({"nchannels": 1}, r"unknown parameter 'nchannels'; did you mean fb_nChannels\?"),
        ({"volume": 1}, "unknown parameter 'volume'; there are: in_doNormalize, "),
        ({"name": "x"}, "unknown parameter 'name'"),
        ({"set_rm_scailing": "_power"}, "unknown parameter"),
        ({5: 1}, "unknown parameter 5"),
        ([("fb_nERBs", 1)], "parameters: list is not a dict"),
        ("fb_nERBs", "parameters: str is not a dict"),
        ({"fb_nERBs": np.nan}, "fb_nERBs: nan is not a finite number"),
        ({"fb_nERBs": "1"}, "fb_nERBs: '1' is not a finite number"),
        ({"fb_nERBs": None}, "fb_nERBs: None is not"),
        ({"fb_nERBs": True}, "fb_nERBs: True is not"),
        ({"fb_nERBs": 0}, "fb_nERBs: 0 is out of range, allowed is more than 0 to 100"),
        ({"fb_nERBs": 1e-3}, "fb_nERBs: .* too many channels"),
        ({"fb_nChannels": 1.5}, "fb_nChannels: 1.5 is not a whole number"),
        ({"fb_nChannels": -1}, "fb_nChannels: -1 is not in the range"),
        ({"fb_lowFreqHz": 9000.0}, "fb_lowFreqHz: 9000 Hz is not below fb_highFreqHz"),
        ({"fb_cfHz": [100.0, np.inf]}, "fb_cfHz: inf is not a finite number"),
        ({"fb_cfHz": np.ma.masked}, "fb_cfHz: nan is not a finite number"),
        ({"fb_lowFreqHz": np.ma.array(80.0, mask=True)}, "fb_lowFreqHz: nan is not a finite number"),
        ({"fb_cfHz": [[100.0]]}, r"fb_cfHz: \[100.0\] is not"),
        ({"fb_cfHz": "100"}, "fb_cfHz: '100' is not a list"),
        ({"fb_cfHz": itertools.count(1)}, "fb_cfHz: too many values, at most 1024"),
        ({"fb_cfHz": [8000.0]}, "fb_cfHz: a channel at 8000 Hz"),
        ({"pp_bRemoveDC": "yes"}, "pp_bRemoveDC: 'yes' is not a boolean"),
        ({"pp_bRemoveDC": 2}, "pp_bRemoveDC: 2 is not a boolean"),
        ({"pp_bRemoveDC": True, "pp_cutoffHzDC": 8000}, "pp_cutoffHzDC: 8000 Hz is not below half the sample rate"),
        ({"pp_middleEarModel": "human"}, "pp_middleEarModel: 'human' is not one of jepsen, lopezpoveda"),
        ({"ihc_method": "Dau"}, "ihc_method: 'Dau' is not one of none, halfwave"),
        ({"ihc_method": "jespen"}, "ihc_method: 'jespen' is not one of"),
        ({"ild_wname": 5}, "ild_wname: 5 is not a string"),
        ({"ild_wSizeSec": 1e-6}, "ild_wSizeSec: too short"),
        ({"ild_wSizeSec": 1e6}, "ild_wSizeSec: 1000000 is out of range"),
        ({"rm_decaySec": 0}, "rm_decaySec: 0 is out of range"),
        ({"cc_maxDelaySec": -1e-3}, "cc_maxDelaySec: -0.001 is out of range"),
        ({"in_normalizeValue": 0}, "in_normalizeValue: 0 is out of range"),
    ],
)
def test_parameters(parameters: Any, match: str) -> None:
    refused(match, GOOD, RATE, parameters=parameters)


@pytest.mark.parametrize(
    "block_frames",
    [
        *(0, -1, 1.5, 12000.0, np.nan, None, True, "100", b"100", [], (), [100, 0], [100, -1], [100, "1"], [[1, 2]]),
        *({1: 2}, np.array(100), np.ma.array([100, 100], mask=[True, False])),
    ],
)
def test_block_sizes(block_frames: Any) -> None:
    refused(
        "^block_frames: .* is not a positive whole number, or a sequence of such$",
        GOOD,
        RATE,
        block_frames=block_frames,
    )


@pytest.mark.parametrize(
    ("modifications", "match"),
    [
        (5, "wanted is a sequence of"),
        (None, "wanted is a sequence of"),
        ("abc", "wanted is a sequence of"),
        ([5], "wanted is a sequence of"),
        ([()], "wanted is a sequence of"),
        ([(0, "fb_nERBs")], "wanted is a sequence of"),
        ((0, "fb_nERBs", 2), "wanted is a sequence of"),
        ([(-1, "fb_nERBs", 2)], "-1 is not a block number"),
        ([(1.0, "fb_nERBs", 2)], "1.0 is not a block number"),
        ([(True, "fb_nERBs", 2)], "True is not a block number"),
        ([("0", "fb_nERBs", 2)], "'0' is not a block number"),
        ([(0, "fb_nErbs", 2)], "unknown parameter 'fb_nErbs'"),
        ([(0, ["fb_nERBs"], 2)], r"unknown parameter \['fb_nERBs'\]"),
        ([(0, "set_rm_scailing", "_log")], "rm_scaling: 'log' is not one of power, magnitude"),
        ([(0, "set_rm_scailing", 1)], "rm_scaling: 1 is not a string"),
        ([(0, "fb_nERBs", 0)], "fb_nERBs: 0 is out of range"),
        ([(99, "fb_nERBs", 0)], "fb_nERBs: 0 is out of range"),
        ([(0, "ihc_method", "none"), (0, "ihc_method", "nothing")], "ihc_method: 'nothing' is not one of"),
        ([(9, "fb_highFreqHz", 9000.0)], "fb_highFreqHz: a channel at .* is not below half the sample rate"),
        ([(3, "fb_highFreqHz", 100.0), (2, "fb_lowFreqHz", 200.0)], "fb_lowFreqHz: 200 Hz is not below"),
        ([(0, "ild_wSizeSec", 1e-6)], "ild_wSizeSec: too short"),
    ],
)
def test_modifications(modifications: Any, match: str) -> None:
    refused(match, GOOD, RATE, block_frames=10, modifications=modifications)


@pytest.mark.parametrize(
    ("outputs", "match"),
    [
        ("crosscorrelation", r"unknown output 'crosscorrelation'; did you mean crossCorrelation\?"),
        ("loudness of it", "unknown output 'loudness of it'; there are: input, preProc, "),
        (["ild", "ILD"], "unknown output 'ILD'"),
        ([5], "unknown output 5"),
        ([["ild"]], "unknown output"),
        (5, "outputs: 5 is not a sequence of names"),
    ],
)
def test_outputs(outputs: Any, match: str) -> None:
    refused(match, GOOD, RATE, outputs=outputs)


def test_what_there_is_is_told_once() -> None:
    with pytest.raises(ValueError, match="unknown parameter 'xyzzy'; there are: in_doNormalize, ") as raised:
        rosafe.process(GOOD, RATE, parameters={"xyzzy": 1})
    names = str(raised.value).partition("there are: ")[2].split(", ")
    assert len(names) == len(set(names)) and "trm_minSpread" in names


@pytest.mark.parametrize("signal", [GOOD[0], GOOD[:1], list(GOOD[0])])
def test_one_ear_has_no_differences(signal: Any) -> None:
    refused(
        "outputs: ild, crossCorrelation compare two ears, and the signal has one",
        signal,
        RATE,
        outputs=CORE_REPRESENTATIONS,
    )
    refused("outputs: precedence compare two ears", signal, RATE, outputs="precedence")


def test_a_signal_with_very_many_blocks_takes_no_memory() -> None:
    signal = np.lib.stride_tricks.as_strided(np.zeros(1, np.int16), (2, 10**9), (0, 0))
    tracemalloc.start()
    try:
        refused("outputs: they would take", signal, RATE, block_frames=[1, 2], outputs=["input", "gammatone"])
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_the_traceback_ends_where_the_user_called() -> None:
    wrong: tuple[dict[str, Any], ...] = ({"parameters": {"volume": 1}}, {"parameters": {"fb_cfHz": [8000.0]}})
    for named in (*wrong, {"outputs": ["x"]}):
        with pytest.raises(ValueError) as raised:
            rosafe.process(GOOD, RATE, **named)
        assert [entry.name for entry in raised.traceback] == [
            "test_the_traceback_ends_where_the_user_called",
            "process",
        ]
        assert raised.value.__suppress_context__


def test_what_follows_the_sample_rate_has_a_name() -> None:
    kinds = [p.kind.name for p in inspect.signature(rosafe.process).parameters.values()]
    assert kinds == ["POSITIONAL_OR_KEYWORD"] * 2 + ["KEYWORD_ONLY"] * 4
    with pytest.warns(DeprecationWarning, match="by name"), pytest.raises(ValueError, match="fb_nERBs"):
        rosafe.process(GOOD, RATE, {"fb_nERBs": 0})
    with pytest.raises(TypeError, match="takes 2 positional arguments, and 7 were given"):
        rosafe.process(GOOD, RATE, {}, 1, (), None, 5)


def test_sizes_that_fill_the_memory() -> None:
    refused("ild_wSizeSec: 60 s of .* MiB, more than 1024 MiB", GOOD, 96000, parameters={"ild_wSizeSec": 60.0})
    refused("more than 1024 MiB", GOOD, 96000, modifications=[(0, "ild_wSizeSec", 60.0)])


def test_results_larger_than_the_memory_that_is_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The rest of the machine's memory is in use: the kernel would end this process."""
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:       24684196 kB\nMemFree: 1 kB\nMemAvailable:      12000 kB\n")
    monkeypatch.setattr(memory, "_MEMINFO", meminfo)
    sound, large = np.zeros((2, 4000)), {"cc_maxDelaySec": 1.0}
    refused(r"outputs: they would take .* GB of memory, this machine has 0\.0 GB left", sound, RATE, parameters=large)
    with pytest.raises(ValueError, match=r"would take .* GB of memory, this machine has 0\.0 GB left"):
        rosafe.Stream(RATE, large).process(sound)
    meminfo.unlink()  # nobody tells
    assert memory.available() == sizes.machine_memory()


def test_a_file_that_is_too_large_is_refused_without_reading_it(tmp_path: Path) -> None:
    """All sizes are checked before the samples are converted or looked at."""
    path = tmp_path / "sound.int16"
    with open(path, "wb") as file:
        file.truncate(4 * 10**12)  # a sparse file, larger than any memory
    sound = np.memmap(path, np.int16, "r").reshape(-1, 2)
    refused("outputs: they would take .* GB of memory", sound, RATE)
    with pytest.raises(ValueError, match=r"block: what comes of it would take .* GB of memory"):
        rosafe.Stream(RATE).process(sound)


def test_results_larger_than_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "machine_memory", lambda: 2**24)
    sound, lags = np.zeros((2, 4000)), {"cc_maxDelaySec": 1.0}
    refused("outputs: they would take .* GB of memory, this machine has", sound, RATE, parameters=lags)
    refused("outputs: they would take", sound, RATE, modifications=[(0, *change) for change in lags.items()])
    at_the_end = [(3, "cc_maxDelaySec", 1e-3)]  # smaller again, but not before it was too large
    refused("outputs: they would take", sound, RATE, parameters=lags, block_frames=1000, modifications=at_the_end)
    hidden = {
        "fb_nChannels": 500,
        "fb_highFreqHz": 4000.0,
    }  # the filterbank is not kept, but all of it comes in one block
    refused("outputs: they would take", sound, RATE, parameters=hidden, outputs=["ild"])
    with pytest.raises(AssertionError, match="it went as far as that"):
        rosafe.process(sound, RATE, parameters=hidden, block_frames=100, outputs=["ild"])
