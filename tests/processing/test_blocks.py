"""Numbers depend neither on blocks nor on branches, to the last bit; both are therefore chosen for speed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

import rosafe
from rosafe.dsp import kernels
from rosafe.processing import chain
from rosafe.processing.files import process_file
from rosafe.representations import BUILTIN, STAGES
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.input import Input
from rosafe.representations.ratemap import Ratemap
from tests.dsp.implementations import NUMPY, levels, using

RATE = 16000.0
FEW = {"fb_nChannels": 5, "fb_highFreqHz": 6000.0}
BYTES = 2 * 5 * 8  # bytes of output of the filterbank per frame
SAMPLES = 3500
SOUND = 0.1 * np.random.default_rng(0).standard_normal((2, SAMPLES))
SOUND[1] = 0.7 * np.roll(SOUND[0], 5) + 0.3 * SOUND[1]
SOUND[:, 1200:1900] = 0.0

with_kernels = pytest.mark.skipif(not kernels.compiled(), reason="twins round otherwise from block to block")
sizes = st.lists(st.one_of(st.integers(60, 700), st.integers(1, 2500)), min_size=1, max_size=6).filter(
    lambda lengths: sum(lengths) > 60 * len(lengths)  # there is another test with blocks of one frame
)
parameters = st.fixed_dictionaries(
    {},
    optional={
        "pp_bRemoveDC": st.just(True),
        "pp_bMiddleEarFiltering": st.just(True),
        "fb_type": st.just("drnl"),
        "fb_nGamma": st.integers(1, 9),
        "fb_nChannels": st.integers(1, 9),
        "ihc_method": st.sampled_from(["none", "hilbert", "joergensen", "breebart", "bernstein"]),
        "rm_scaling": st.just("magnitude"),
        "rm_hSizeSec": st.sampled_from([0.001, 0.013, 0.03]),
        "rm_wSizeSec": st.sampled_from([0.002, 0.0301, 0.1]),
        "ild_hSizeSec": st.sampled_from([0.0011, 0.025]),
        "ild_wSizeSec": st.sampled_from([0.0007, 0.0301]),
        "cc_wSizeSec": st.sampled_from([0.005, 0.06]),
        "cc_maxDelaySec": st.sampled_from([0.0002, 0.004, 0.04]),
        "adpt_lim": st.sampled_from([0.0, 5.0]),
        "ams_fbType": st.just("lin"),
        "ac_clipMethod": st.sampled_from(["clc", "sgn"]),
    },
)


@contextmanager
def at_most(size: int) -> Iterator[list[int]]:
    """Limit merged blocks to `size` bytes of output, and record the lengths of the blocks that the input receives."""
    lengths: list[int] = []
    process = Input.process

    def watch(self: Input, block: Any, extra: Any = None) -> Any:
        lengths.append(np.shape(block)[-1])
        return process(self, block, extra)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chain, "MAX_BYTES", size)
        patch.setattr(Input, "process", watch)
        yield lengths


def assert_same(got: dict[str, Any], expected: dict[str, Any]) -> None:
    assert got.keys() == expected.keys()
    for name in expected:
        np.testing.assert_array_equal(got[name], expected[name], err_msg=name)


@with_kernels
@given(sizes=sizes, given_parameters=parameters)
@settings(max_examples=4)
def test_all_representations_are_independent_of_blocks(sizes: list[int], given_parameters: dict[str, Any]) -> None:
    options: dict[str, Any] = {"parameters": {**FEW, **given_parameters}, "outputs": sorted(BUILTIN)}
    with at_most(0) as lengths:
        whole = rosafe.process(SOUND, RATE, block_frames=SAMPLES, **options)
        assert lengths == [SAMPLES]
        in_blocks = rosafe.process(SOUND, RATE, block_frames=sizes, **options)
        assert max(lengths[1:]) <= max(sizes)
    assert_same(in_blocks, whole)


@with_kernels
@pytest.mark.parametrize(("channels", "block"), [(1, 100), (1, 2000), (2, 700)])
def test_long_sums_are_independent_of_blocks(channels: int, block: int) -> None:
    """Sums over more than 8192 numbers; correlations over more than 1024 lags use the FFT."""
    sound = 0.1 * np.random.default_rng(1).standard_normal((2, 14_000))
    values = {"cc_wSizeSec": 0.6, "cc_maxDelaySec": 0.04, "cc_hSizeSec": 0.05, "ac_wSizeSec": 0.6, "prec_wSizeSec": 0.6}
    options: dict[str, Any] = {
        "parameters": {**FEW, **values, "fb_nChannels": channels},
        "outputs": ["crossCorrelation", "itd", "autocorrelation", "pitch", "precedence"],
    }
    with at_most(0):
        whole = rosafe.process(sound, RATE, block_frames=14_000, **options)
        assert whole["crossCorrelation"].shape[-1] > 3
        assert_same(rosafe.process(sound, RATE, block_frames=block, **options), whole)


@with_kernels
def test_blocks_of_one_frame_and_long_decays() -> None:
    sound = np.zeros((2, 9000))
    sound[:, :300], sound[:, 8000], sound[0, 8400:8410] = SOUND[:, :300], 1e-300, 1e80
    with at_most(0):
        for frames, block, kind in ((700, 1, "gammatone"), (9000, 100, "gammatone"), (9000, 77, "drnl")):
            options: dict[str, Any] = {"parameters": {**FEW, "fb_type": kind}, "outputs": sorted(BUILTIN)}
            whole = rosafe.process(sound[:, :frames], RATE, block_frames=frames, **options)
            assert_same(rosafe.process(sound[:, :frames], RATE, block_frames=block, **options), whole)


@with_kernels
@pytest.mark.parametrize(
    ("size", "blocks", "lengths"),
    [
        (2**22, 100, [3500]),
        (1000, 100, [1000, 1000, 1000, 500]),
        (1099, 100, [1000, 1000, 1000, 500]),
        (199, 100, [100] * 35),
        (0, 1000, [1000, 1000, 1000, 500]),
        (900, 1000, [1000, 1000, 1000, 500]),  # larger blocks are not merged
        (1000, [600, 300, 200, 900], [900, 200, 900, 900, 600]),
    ],
)
def test_small_blocks_are_merged(size: int, blocks: Any, lengths: list[int], tmp_path: Path) -> None:
    """Blocks are merged up to the limit."""
    options: dict[str, Any] = {"parameters": FEW, "block_frames": blocks}
    with at_most(0):
        alone = rosafe.process(SOUND, RATE, **options)
    with at_most(size * BYTES) as seen:
        assert_same(rosafe.process(SOUND, RATE, **options), alone)
        assert seen == lengths
        if not isinstance(blocks, int):
            return
        scipy.io.wavfile.write(tmp_path / "sound.wav", int(RATE), SOUND.T.astype(np.float32))
        seen.clear()
        process_file(tmp_path / "sound.wav", tmp_path / "results.npz", FEW, blocks)
        assert seen == lengths
    assert rosafe.load(tmp_path / "results.npz")["block_frames"] == blocks


@with_kernels
def test_merged_blocks_have_at_most_the_default_length() -> None:
    """This limit also holds with few channels, so that processors work concurrently on short sounds."""
    sound = np.zeros((2, 30_000))
    with at_most(2**22) as seen:
        rosafe.process(sound, RATE, parameters={"fb_nChannels": 1}, block_frames=1000, outputs=["ratemap"])
    assert seen == [12_000, 12_000, 6000]


@with_kernels
def test_reading_stops_at_the_end() -> None:
    """Reading a block may take long."""
    read: list[int] = []

    def blocks() -> Iterator[np.ndarray]:
        for number in range(100):
            read.append(number)
            if number == 5:
                made._source.stop()
            yield np.zeros((2, 100))

    with chain.Chain(blocks(), RATE, FEW, ["ratemap"], lambda *_: None) as made:
        made.run(merge=True)
    assert len(read) <= 7


def test_numpy_overwrites_no_input() -> None:
    with using(NUMPY):
        stream = rosafe.Stream(RATE, parameters=FEW, outputs=["ild"])
        stream.process(SOUND)
        assert not any(over for _, _, _, over, _ in stream._plan)


@pytest.mark.parametrize("why", ["changes", "gain control", "a plugin", "twins"])
def test_blocks_are_not_merged_if_the_numbers_could_change(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {"parameters": dict(FEW), "block_frames": 1000, "outputs": ["ratemap"]}
    if why == "changes":
        options["modifications"] = [(2, "rm_scaling", "magnitude")]
    elif why == "gain control":
        options["parameters"]["pp_bNormalizeRMS"] = True
    elif why == "a plugin":
        monkeypatch.setattr(chain, "BUILTIN", BUILTIN - {"ratemap"})
    with at_most(2**22) as seen, using(NUMPY if why == "twins" else [NUMPY, *levels()][-1]):
        rosafe.process(SOUND, RATE, **options)
    assert seen == [1000, 1000, 1000, 500]


# --- branches ---


@contextmanager
def workers(count: int) -> Iterator[list[int]]:
    """Set the number of workers for signals of any length; record the number of channels of each filterbank."""
    channels: list[int] = []
    process = Filterbank.process

    def watch(self: Filterbank, block: Any, *more: Any) -> Any:
        output = process(self, block, *more)
        channels.append(output.shape[1])
        return output

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROSAFE_WORKERS", str(count))
        patch.setattr(chain, "MAX_FRAMES", 500)
        patch.setattr(Filterbank, "process", watch)
        yield channels


APART = [kind for kind, stage in STAGES.items() if stage.CHANNEL_INDEPENDENT]


@with_kernels
@pytest.mark.parametrize(
    ("count", "channels", "shares"),
    [(2, 31, [15, 16]), (2, 33, [16, 17]), (3, 40, [8, 16, 16]), (8, 17, [1, 8, 8]), (2, 8, [8]), (1, 64, [64])],
)
@pytest.mark.parametrize("ears", [2, 1])
def test_a_branch_for_each_worker(count: int, channels: int, shares: list[int], ears: int) -> None:
    """Branches begin at the filterbank and have whole groups of lanes; the numbers are the same."""
    outputs = [kind for kind in APART if ears == 2 or kind not in ("ild", "crossCorrelation")]
    parameters = {**FEW, "fb_nChannels": channels, "cc_maxDelaySec": 0.0007, "ihc_method": "bernstein"}
    options: dict[str, Any] = {"parameters": parameters, "outputs": ["preProc", *outputs], "block_frames": 500}
    sound = SOUND[:ears]
    with workers(1) as seen:
        alone = rosafe.process(sound, RATE, **options)
        assert set(seen) == {channels}
    with workers(count) as seen:
        assert_same(rosafe.process(sound, RATE, **options), alone)
        assert sorted(set(seen)) == sorted(set(shares)) and sum(seen) == 7 * channels


@with_kernels
def test_stages_across_channels_have_one_branch() -> None:
    for kind in sorted(BUILTIN - set(APART) - {"input", "preProc"}):
        with workers(2) as seen:
            rosafe.process(SOUND, RATE, parameters={**FEW, "fb_nChannels": 20}, outputs=["ratemap", kind])
        assert set(seen) == {20}, kind
    with workers(2) as seen:
        rosafe.process(
            SOUND, RATE, parameters={**FEW, "fb_nChannels": 20}, outputs=["ild"], modifications=[(0, "fb_nGamma", 3)]
        )
    assert set(seen) == {20}


@with_kernels
def test_an_error_in_one_branch_ends_all(monkeypatch: pytest.MonkeyPatch) -> None:
    class Fuse(Ratemap):
        def process(self, block: Any, extra: Any = None, out: Any = None) -> Any:
            if block.shape[1] == 12:
                raise ArithmeticError("in the last branch")
            return super().process(block, extra)

    monkeypatch.setitem(STAGES, "ratemap", Fuse)
    with workers(2), pytest.raises(ArithmeticError, match="in the last branch"):
        rosafe.process(SOUND, RATE, parameters={**FEW, "fb_nChannels": 20}, outputs=["ratemap", "ild"])
