"""`rosafe.Stream`: the numbers of `rosafe.process` for any blocks, and invalid arguments."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rosafe
from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.representations import STAGES
from rosafe.tree import sizes
from tests.representations.chain import Chain, cut

RATE = 16000
FEW = {"fb_nChannels": 4}
SOUND = 0.1 * np.random.default_rng(0).standard_normal((2, 3000))


def joined(stream: rosafe.Stream, blocks: list[Any]) -> dict[str, np.ndarray]:
    """Return the joined outputs for `blocks`."""
    made = [stream.process(block) for block in blocks]
    return {name: np.concatenate([one[name] for one in made], axis=-1) for name in made[0]}


def assert_same(got: dict[str, Any], expected: dict[str, Any]) -> None:
    for name, value in got.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


@settings(max_examples=15)
@given(st.lists(st.integers(1, 900), min_size=1, max_size=5))
def test_any_blocks_give_the_numbers_of_process(lengths: list[int]) -> None:
    got = joined(rosafe.Stream(RATE, FEW), cut(SOUND, lengths))
    assert set(CORE_REPRESENTATIONS) < set(got)
    assert_same(got, rosafe.process(SOUND, RATE, parameters=FEW, block_frames=lengths))


def test_all_kinds() -> None:
    kinds = list(STAGES)
    got = joined(rosafe.Stream(RATE, FEW, kinds), cut(SOUND, 700))
    assert_same(got, rosafe.process(SOUND, RATE, parameters=FEW, block_frames=700, outputs=kinds))


def test_changes_on_the_way() -> None:
    """One change needs a new extra of the filterbank, and one belongs to a kind that is not computed."""
    changes = [(1, "ihc_method", "bernstein"), (2, "fb_lowFreqHz", 300.0), (3, "set_rm_scailing", "_magnitude")]
    changes += [(4, "rm_hSizeSec", 0.02), (4, "ac_K", 1.0)]
    outputs = ["ihc", "ratemap"]
    expected = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=500, modifications=changes, outputs=outputs)
    stream = rosafe.Stream(RATE, FEW, outputs)
    made = []
    for number, block in enumerate(cut(SOUND, 500)):
        for _, name, value in (change for change in changes if change[0] == number):
            stream.modify(name, value)
        made.append(stream.process(block))
    assert_same({name: np.concatenate([one[name] for one in made], axis=-1) for name in made[0]}, expected)
    assert stream.describe()["ratemap_frameRate"] == 50.0
    assert stream.describe()["parameters"]["fb_lowFreqHz"] == 300.0


def test_reset_keeps_the_parameters() -> None:
    stream = rosafe.Stream(RATE, FEW)
    stream.modify("rm_decaySec", 0.02)
    first = joined(stream, cut(SOUND, 441))
    stream.reset()
    assert_same(joined(stream, cut(SOUND, 441)), first)
    stream.reset()
    whole = (SOUND * 2**31).astype(np.int32)
    assert np.abs(joined(stream, cut(whole, 441))["input"] - SOUND).max() < 1e-8


def test_one_ear_and_blocks_with_frames_first() -> None:
    mono = joined(rosafe.Stream(RATE, FEW), cut(SOUND[0], 333))
    assert_same(mono, rosafe.process(SOUND[0], RATE, parameters=FEW, block_frames=333))
    assert "ild" not in mono and mono["ratemap"].shape[0] == 1
    lengths = [300, 2, 1, 0, 2, 700]
    ends = np.cumsum(lengths)
    frames_first = [SOUND.T[end - length : end] for end, length in zip(ends, lengths, strict=True)]
    flat = [block.T for block in frames_first]
    assert_same(joined(rosafe.Stream(RATE, FEW), frames_first), joined(rosafe.Stream(RATE, FEW), flat))
    stream = rosafe.Stream(RATE, FEW)
    joined(stream, [SOUND[0]])
    stream.reset()
    assert_same(joined(stream, cut(SOUND, 500)), rosafe.process(SOUND, RATE, parameters=FEW, block_frames=500))


def test_blocks_of_16_bits_as_from_sounddevice() -> None:
    short = np.round(SOUND.T * 2**15).astype(np.int16)
    got = joined(rosafe.Stream(RATE, FEW, "ratemap"), [short[at : at + 160] for at in range(0, 3000, 160)])
    assert_same(got, rosafe.process(short, RATE, parameters=FEW, block_frames=160, outputs="ratemap"))


def test_describe() -> None:
    stream = rosafe.Stream(RATE, FEW, ["ild", "crossCorrelation"])
    described = stream.describe()
    assert (
        described["sample_rate"] == RATE
        and described["parameters"]["fb_highFreqHz"] == described["fb_cfHz"][-1] == 7600.0
    )
    assert described["axes"] == {"ild": ("channel", "time"), "crossCorrelation": ("channel", "lag", "time")}
    assert described["units"]["ild"] == "dB" and described["ild_frameRate"] == 100.0 and len(described["cc_lags"]) == 37


def test_a_stream_with_the_described_parameters_is_equal() -> None:
    for parameters in ({"fb_cfHz": [200.0, 400.0, 900.0]}, {"fb_nChannels": 3}, {}):
        first = rosafe.Stream(RATE, parameters, ["ratemap"])
        sound = np.random.default_rng(1).standard_normal((2, 1000))
        got = first.process(sound)
        second = rosafe.Stream(RATE, first.describe()["parameters"], ["ratemap"])
        assert_same(second.process(sound), got)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((0,), "sample_rate: expected a number .*, got 0"),
        ((RATE, {"fb_highFreqHz": 9000.0}), "use at most 7600 Hz"),
        ((RATE, None, ["ratemaps"]), r"'ratemaps'; did you mean ratemap\?"),
        ((96000, {"ild_wSizeSec": 60.0}), "expected at most 1024 MiB"),
    ],
)
def test_invalid_arguments(arguments: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match) as raised:
        rosafe.Stream(*arguments)
    assert [entry.name for entry in raised.traceback][1:] == ["__init__"]


def test_refused_blocks_and_changes_have_no_effect() -> None:
    stream, other = rosafe.Stream(RATE, FEW), rosafe.Stream(RATE, FEW)
    for block in (SOUND[:, :500], SOUND[:, 500:]):
        for bad in (np.zeros((3, 5)), np.full((2, 5), np.nan), "sound", np.zeros((2, 5), bool)):
            with pytest.raises(ValueError, match="signal"):
                stream.process(bad)
        with pytest.raises(ValueError, match="did you mean"):
            stream.modify("fb_nchannel", 3)
        for name, value in (("fb_nChannels", -1), ("fb_highFreqHz", 9000.0), ("ild_wSizeSec", 1e-6)):
            with pytest.raises(ValueError, match=name):
                stream.modify(name, value)
        assert_same(stream.process(block), other.process(block))
        with pytest.raises(ValueError, match="expected floats"):
            stream.process(np.zeros((2, 5), np.int32))
        with pytest.raises(ValueError, match="expected two ears"):
            stream.process(np.zeros(5))
    with pytest.raises(
        ValueError, match=r"^outputs: expected representations of single ears for a signal with one ear, got ild"
    ):
        rosafe.Stream(RATE, FEW, ["ild"]).process(SOUND[0])


@pytest.mark.parametrize("bad", [np.full(5, np.nan), np.full((5, 2), np.inf), np.ones(2000, np.int16)])
def test_a_refused_first_block_changes_nothing(bad: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stream does not remember its number of ears, number type or orientation."""
    stream = rosafe.Stream(RATE, FEW)
    with monkeypatch.context() as patch:
        patch.setattr(sizes, "available_memory", lambda: 10**5)  # bytes: too few for 2000 samples
        with pytest.raises(ValueError, match=r"NaN|^block: expected at most 0\.10 MiB"):
            stream.process(bad)
    pair = np.array([[1.0, 2.0], [3.0, 4.0]])  # read as (2, N), which a first block of (N, 2) would change
    assert_same(stream.process(pair), rosafe.Stream(RATE, FEW).process(pair))


def test_no_threads_and_little_overhead() -> None:
    """Medians of alternating runs; benchmarks/stream.py measures precisely."""
    rate, frames = 44100, 441
    sound = 0.1 * np.random.default_rng(1).standard_normal((2, 60 * frames))
    before = threading.active_count()
    stream, stages = rosafe.Stream(rate), Chain(float(rate), CORE_REPRESENTATIONS, {"in_doNormalize": False})
    seconds: dict[Any, list[float]] = {stream: [], stages: []}
    for block in cut(sound, frames) * 3:
        for one, taken in seconds.items():
            begun = time.perf_counter()
            one.process(block)
            taken.append(time.perf_counter() - begun)
    assert threading.active_count() == before
    assert np.median(seconds[stream]) < 3 * np.median(seconds[stages])  # 1.3 on a quiet machine
