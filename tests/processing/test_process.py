"""Results of `rosafe.process`: reference vectors, any blocks, parts of the outputs, unusual signals."""

from __future__ import annotations

import functools
import gc
import threading
import tracemalloc
import weakref
from signal import SIG_IGN, SIGINT, pthread_kill
from signal import signal as on_signal
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rosafe
from rosafe.interface import CORE_REPRESENTATIONS
from rosafe.processing import chain
from rosafe.representations import STAGES
from rosafe.representations.haircell import InnerHairCell
from tests import harness
from tests.dsp.bare import cut
from tests.dsp.implementations import NUMPY, levels, using
from tests.representations.chain import core_chain
from tests.tree.support import tree_threads

RATE = 16000.0
FEW = {"fb_nChannels": 4, "fb_highFreqHz": 4000.0}
SOUND = 0.1 * np.random.default_rng(0).standard_normal((2, 3000))
FRAMED = ("ild", "ratemap", "crossCorrelation")


def noise(frames: int, seed: int = 1) -> NDArray[np.float64]:
    return 0.1 * np.random.default_rng(seed).standard_normal((2, frames))


def assert_same(got: dict[str, Any], wanted: dict[str, Any], tolerance: float = 1e-12) -> None:
    assert got.keys() == wanted.keys()
    for name in wanted:
        np.testing.assert_allclose(got[name], wanted[name], rtol=0, atol=tolerance, err_msg=name)


# --- numbers ---


def test_keys_shapes_and_types() -> None:
    frames = 16000
    results = rosafe.process(noise(frames), RATE)
    channels = len(results["fb_cfHz"])
    shapes = {name: np.shape(value) for name, value in results.items()}
    assert shapes == {
        "input": (2, frames),
        "input_time": (frames,),
        "preProc": (2, frames),
        "preProc_time": (frames,),
        "gammatone": (2, channels, frames),
        "gammatone_time": (frames,),
        "fb_cfHz": (31,),
        "ihc": (2, channels, frames),
        "ihc_time": (frames,),
        "ild": (channels, 99),
        "ild_time": (99,),
        "ild_frameRate": (),
        "ratemap_time": (99,),
        "crossCorrelation_time": (99,),
        "ratemap": (2, channels, 99),
        "ratemap_frameRate": (),
        "crossCorrelation": (channels, 37, 99),
        "crossCorrelation_frameRate": (),
        "cc_lags": (37,),
    }
    assert all(np.asarray(value).dtype == np.float64 for value in results.values())
    np.testing.assert_allclose(results["cc_lags"], np.arange(-18, 19) / RATE)
    assert [results[f"{kind}_frameRate"] for kind in FRAMED] == [100.0] * 3


def test_integers_are_normalised_and_floats_are_not() -> None:
    whole = (noise(2000) * 2**30).astype(np.int32)
    float_input = rosafe.process(whole.astype(float), RATE, outputs=["input"])["input"]
    np.testing.assert_array_equal(float_input, whole)
    cases: list[tuple[NDArray[Any], dict[str, Any], int]] = [
        (whole, {}, 2**31 - 1),
        (whole.astype(">i4"), {}, 2**31 - 1),
        (whole, {"in_normalizeValue": 1000}, 1000),
        (whole, {"in_doNormalize": False}, 1),
        (whole.astype(float), {"in_doNormalize": True}, 2**31 - 1),
        (whole.astype(float), {"in_normalizeValue": 1000}, 1),
    ]
    for signal, values, divisor in cases:
        got = rosafe.process(signal, RATE, parameters=values, outputs=["input"])["input"]
        np.testing.assert_array_equal(got, whole / divisor)
    full_scale = rosafe.process(np.array([[-(2**31)], [2**31 - 1]], np.int32), RATE, outputs=["input"])
    np.testing.assert_array_equal(full_scale["input"], [[-1.0000000004656613], [1.0]])


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.longdouble])
def test_other_floats(kind: Any) -> None:
    signal = noise(500).astype(kind)
    assert_same(
        rosafe.process(signal, RATE, parameters=FEW),
        rosafe.process(signal.astype(float), RATE, parameters=FEW),
        tolerance=0,
    )


def test_any_memory_layout_and_lists() -> None:
    signal = noise(600)
    wanted = rosafe.process(signal, RATE, parameters=FEW)
    backwards = signal[:, ::-1].copy()[:, ::-1]
    for same in (np.asfortranarray(signal), backwards, signal.tolist(), signal.T.copy().T):
        assert_same(rosafe.process(same, RATE, parameters=FEW), wanted, tolerance=0)


def test_the_signal_is_unchanged_and_not_shared_with_results() -> None:
    signal = noise(600)
    before = signal.copy()
    results = rosafe.process(signal, RATE, parameters=FEW)
    np.testing.assert_array_equal(signal, before)
    arrays = [value for value in results.values() if isinstance(value, np.ndarray)]
    assert not any(np.shares_memory(signal, array) for array in arrays)
    assert all(array.flags.writeable for array in arrays)


# --- odd signals ---


@pytest.mark.parametrize("frames", [0, 1, 159, 319])
@pytest.mark.parametrize("block", [1, 100, 12000])
def test_less_than_a_window(frames: int, block: int) -> None:
    results = rosafe.process(noise(frames), RATE, parameters=FEW, block_frames=block, outputs=[*FRAMED, "ihc", "input"])
    assert {name: np.shape(results[name]) for name in ("input", "ihc", *FRAMED)} == {
        "input": (2, frames),
        "ihc": (2, 4, frames),
        "ild": (4, 0),
        "ratemap": (2, 4, 0),
        "crossCorrelation": (4, 37, 0),
    }
    assert len(results["cc_lags"]) == 37
    assert len(results["fb_cfHz"]) == 4
    assert results["ild_frameRate"] == 100.0


def test_silence() -> None:
    results = rosafe.process(
        np.zeros((2, 3000)),
        RATE,
        parameters={**FEW, "pp_bNormalizeRMS": True, "pp_bMiddleEarFiltering": True, "ihc_method": "bernstein"},
    )
    for name in ("preProc", "gammatone", "ihc", *FRAMED):
        assert not results[name].any(), name


# --- shapes and types ---


def test_two_ears_along_either_axis() -> None:
    """(N, 2) as soundfile returns it; (2, 2) is read as (2, N), and (1, 2) as one ear."""
    wanted = rosafe.process(SOUND, RATE, parameters=FEW)
    assert_same(rosafe.process(SOUND.T, RATE, parameters=FEW), wanted, tolerance=0)
    tiny = np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(rosafe.process(tiny, RATE, outputs="input")["input"], tiny)
    np.testing.assert_array_equal(rosafe.process(tiny[:1], RATE, outputs="input")["input"], tiny[:1])
    assert rosafe.process(np.zeros((0, 2)), RATE, outputs="input")["input"].shape == (2, 0)


def test_integers_are_scaled_as_in_files() -> None:
    short = (2**15 * 0.9 * np.random.default_rng(5).uniform(-1, 1, (2, 500))).astype(np.int16)
    long = short.astype(np.int32) * 2**16
    np.testing.assert_array_equal(*(rosafe.process(x, RATE, outputs="input")["input"] for x in (short, long)))
    raw = rosafe.process(short, RATE, parameters={"in_doNormalize": False}, outputs="input")
    np.testing.assert_array_equal(raw["input"], long)


# --- times ---


def test_the_middle_of_each_frame() -> None:
    """A click is in the frames whose middles are less than half a window away."""
    rate = 44100
    sound = np.zeros((2, rate // 2))
    sound[:, 9999] = 1.0
    values = {"fb_cfHz": [15000.0], "rm_wSizeSec": 0.013, "rm_hSizeSec": 0.004, "rm_decaySec": 1e-5, "fb_bwERBs": 4.0}
    got = rosafe.process(sound, rate, parameters=values, outputs=["ratemap", "ihc"])
    window, hop = 2 * round(0.0065 * rate), round(0.004 * rate)
    np.testing.assert_allclose(got["ratemap_time"], (np.arange(got["ratemap"].shape[2]) * hop + window / 2) / rate)
    np.testing.assert_allclose(got["ihc_time"], np.arange(rate // 2) / rate)
    level = got["ratemap"][0, 0]
    heard = np.abs(got["ratemap_time"] - 9999 / rate)
    assert level[heard < 0.003].min() > 1e3 * level[heard > 0.0075].max()


@pytest.mark.parametrize("ratio", [1, 4, 5])
def test_times_of_decimated_outputs(ratio: int) -> None:
    """Each sample covers the time until the next one."""
    values = {**FEW, "ams_dsRatio": ratio, "ams_wSizeSec": 0.032, "ams_hSizeSec": 0.008, "ams_cfHz": [50.0]}
    got = rosafe.process(SOUND, RATE, parameters=values, outputs="amsFeatures")
    window = 2 * round(0.016 * RATE / ratio) * ratio
    hop = round(window / ratio / 4) * ratio
    frames = got["amsFeatures"].shape[-1]
    np.testing.assert_allclose(got["amsFeatures_time"], (np.arange(frames) * hop + window / 2) / RATE, rtol=1e-12)
    assert frames > 3


def test_times_after_a_change_of_the_hop() -> None:
    """The change does not move the start of the next frame."""
    changes = [(1, "ild_hSizeSec", 0.02), (2, "ild_wSizeSec", 0.03)]
    got = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=1000, modifications=changes, outputs=["ild"])
    # 320 samples each 160 up to sample 1000; each 320 up to 2000; then 480 samples each 320
    starts = [0, 160, 320, 480, 640, 800, 1120, 1440, 1760, 2080, 2400]
    windows = [320] * 8 + [480] * 3
    np.testing.assert_allclose(got["ild_time"], (np.array(starts) + np.array(windows) / 2) / RATE)
    assert got["ild"].shape[1] == len(starts)


# --- parts of the outputs ---


@pytest.mark.parametrize("kind", CORE_REPRESENTATIONS)
def test_unneeded_kinds_are_not_computed(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = rosafe.process(SOUND, RATE, parameters=FEW)
    needed = [kind]
    while parent := CORE_REPRESENTATIONS[needed[-1]].parent:
        needed.append(parent)

    def refuse(*arguments: Any, **parameters: Any) -> None:
        raise AssertionError("not asked for")

    for other in set(STAGES) - set(needed):
        stage = functools.partial(refuse)
        stage.effective_values = STAGES[other].effective_values  # type: ignore[attr-defined]  # parameters are checked
        monkeypatch.setitem(STAGES, other, stage)  # type: ignore[misc]
    results = rosafe.process(SOUND, RATE, parameters=FEW, outputs=[kind])
    coordinates = {f"{kind}_time", *(["fb_cfHz"] if "gammatone" in needed else [])}
    if kind in FRAMED:
        coordinates.add(f"{kind}_frameRate")
    if kind == "crossCorrelation":
        coordinates.add("cc_lags")
    assert set(results) == {kind} | coordinates
    assert_same(results, {name: whole[name] for name in results}, tolerance=0)


def test_outputs_in_any_form() -> None:
    assert set(rosafe.process(SOUND, RATE, parameters=FEW, outputs="preProc")) == {"preProc", "preProc_time"}
    twice = rosafe.process(SOUND, RATE, parameters=FEW, outputs=("preProc", "input", "input"))
    assert set(twice) == {"preProc", "preProc_time", "input", "input_time"}
    with pytest.raises(ValueError, match="outputs: expected at least one name, got none"):
        rosafe.process(SOUND, RATE, parameters=FEW, outputs=[])


@pytest.mark.usefixtures("blocks_not_merged")
def test_outputs_that_are_not_requested_are_not_stored() -> None:
    """Twice the signal takes no more memory, except for a few frames of ILD, and blocks that wait for a thread."""

    def peak(frames: int) -> int:
        signal = noise(frames)
        tracemalloc.start()
        try:
            rosafe.process(signal, RATE, parameters=FEW, block_frames=1000, outputs=["ild"])
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2000)  # imports and caches
    gammatone_bytes = 2 * 4 * 8 * 40_000
    assert peak(80_000) - peak(40_000) < 0.3 * gammatone_bytes


# --- changes on the way ---


def test_changes_apply_before_their_blocks() -> None:
    """Changes are ordered by block; those for one block keep their order; those beyond the end are ignored."""
    changes = [
        (5, "ihc_method", "dau"),
        (2, "fb_bwERBs", 1.3),
        (2, "ihc_method", "hilbert"),
        (0, "pp_bRemoveDC", True),
        (3, "ild_hSizeSec", 0.005),
        (2, "fb_bwERBs", 1.2),
        (1, "pp_refSPLdBS", 90),
        (1, "pp_bLevelScaling", 1),
        (6, "rm_scaling", "magnitude"),
        (99, "ild_wSizeSec", 0.04),
        (99, "fb_highFreqHz", 9999.0),
    ]
    results = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=500, modifications=changes)
    stages = core_chain(RATE, {**FEW, "in_doNormalize": False})
    made = [(at, name.replace("BS", "B"), value) for at, name, value in changes if at < 6]
    outputs = stages.blocks(cut(SOUND, 500), sorted(made, key=lambda change: change[0]))
    for kind in CORE_REPRESENTATIONS:
        wanted = np.concatenate([output[kind] for output in outputs], axis=-1)
        np.testing.assert_allclose(results[kind], wanted, rtol=0, atol=1e-12, err_msg=kind)
    assert results["ild_frameRate"] == 200.0
    assert results["fb_cfHz"][-1] == 4000.0


def test_changes_of_kinds_that_are_not_computed_have_no_effect() -> None:
    with_changes = rosafe.process(
        SOUND, RATE, parameters=FEW, modifications=[(0, "ild_wname", "hamming")], outputs=["preProc"]
    )
    assert_same(with_changes, rosafe.process(SOUND, RATE, parameters=FEW, outputs=["preProc"]), tolerance=0)


def test_lags_and_channels_that_change_leave_zeros_outside() -> None:
    """Lags are centred on lag zero, channels begin at the first."""
    changes = [(1, "cc_maxDelaySec", 0.002), (2, "fb_nChannels", 6), (3, "cc_maxDelaySec", 0.0005)]
    results = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=750, modifications=changes)
    outputs = core_chain(RATE, {**FEW, "in_doNormalize": False}).blocks(cut(SOUND, 750), changes)
    assert results["crossCorrelation"].shape[:2] == (6, 65)
    assert results["ihc"].shape == (2, 6, 3000)
    assert results["ild"].shape[0] == 6
    np.testing.assert_allclose(results["cc_lags"], np.arange(-32, 33) / RATE)
    assert len(results["fb_cfHz"]) == 6
    at = 0
    for number, (channels, reach) in enumerate(((4, 18), (4, 32), (6, 32), (6, 8))):
        wanted = outputs[number]["crossCorrelation"]
        got = results["crossCorrelation"][..., at : at + wanted.shape[-1]].copy()
        inner = got[:channels, 32 - reach : 32 + reach + 1]
        np.testing.assert_allclose(inner, wanted, rtol=0, atol=1e-12)
        inner[:] = 0
        assert not got.any()
        at += wanted.shape[-1]
        block = results["ihc"][..., number * 750 : (number + 1) * 750]
        np.testing.assert_allclose(block[:, :channels], outputs[number]["ihc"], rtol=0, atol=1e-12)
        assert not block[:, channels:].any()
    assert at == results["crossCorrelation"].shape[-1]


# --- several at once, and ends before the end ---


def test_several_calls_at_once() -> None:
    signals = [noise(4000, seed) for seed in range(4)]
    alone = [rosafe.process(signal, RATE, parameters=FEW) for signal in signals]
    for got, wanted in zip(
        harness.run_together(4, lambda user: rosafe.process(signals[user], RATE, parameters=FEW, block_frames=333)),
        alone,
        strict=True,
    ):
        assert_same(got, wanted)


class Blown(Exception):
    pass


@pytest.mark.usefixtures("blocks_not_merged")
def test_an_error_during_the_run_ends_it_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    processed = []

    class Fuse(InnerHairCell):
        def process(self, block: Any, envelope: Any = None, out: Any = None) -> Any:
            processed.append(block)
            if len(processed) == 3:
                raise Blown("in the third block")
            return super().process(block, envelope)

    monkeypatch.setitem(STAGES, "ihc", Fuse)
    read = []
    original = chain._GatedSource.read

    def counting(self: Any) -> Any:
        read.append(self)
        return original(self)

    monkeypatch.setattr(chain._GatedSource, "read", counting)
    with pytest.raises(Blown, match="third"):
        rosafe.process(noise(100_000), RATE, parameters=FEW, block_frames=10)
    assert len(processed) == 3
    assert len(read) < 5000  # of 10000: the tree notices after a few blocks


@pytest.mark.usefixtures("blocks_not_merged")
def test_an_interrupt_from_the_keyboard(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupt during the computation ends it with all its threads."""
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("pytest-xdist runs this process in another thread, which does not get signals")
    processed: list[int] = []
    seen: list[int] = []

    def interrupt(number: int, frame: object) -> None:
        on_signal(SIGINT, SIG_IGN)
        seen.append(number)
        raise KeyboardInterrupt

    def sent() -> bool:
        """Repeat the signal until it is handled: the main thread may notice it only at its next wake-up."""
        if not seen:
            pthread_kill(threading.main_thread().ident or 0, SIGINT)
        return bool(seen)

    class Interrupting(InnerHairCell):
        def process(self, block: Any, envelope: Any = None, out: Any = None) -> Any:
            processed.append(block.shape[-1])
            if len(processed) == 3:
                harness.wait_for(sent)
            return super().process(block, envelope)

    monkeypatch.setitem(STAGES, "ihc", Interrupting)
    before = on_signal(SIGINT, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            rosafe.process(noise(20_000), RATE, parameters=FEW, block_frames=10)
    finally:
        on_signal(SIGINT, before)
    assert tree_threads() == set()
    assert len(processed) < 1000


@pytest.mark.parametrize("outputs", [["gammatone"], ["ihc"], ["ild", "ratemap", "crossCorrelation"], ["input", "ihc"]])
@pytest.mark.parametrize(
    ("frames", "choice"), [(3000, NUMPY), *((n, level) for n in (3000, 30_000) for level in levels()[-1:])]
)
def test_results_are_freed_with_their_last_reference(outputs: list[str], frames: int, choice: int) -> None:
    """Results are not part of reference cycles, which the garbage collector would free later."""
    gc.collect()
    gc.disable()
    try:
        with using(choice):
            results = rosafe.process(noise(frames), RATE, parameters={"fb_nChannels": 20}, outputs=outputs)
        held = {
            name: weakref.ref(results[name] if results[name].base is None else results[name].base) for name in outputs
        }
        del results
        assert [name for name, array in held.items() if array() is not None] == []
    finally:
        gc.enable()
