"""Each kernel against its equivalent in numpy, for all parameters; and one stream processed by both."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp import kernels
from rosafe.dsp.framing import FrameBuffer, FrameGrid
from rosafe.dsp.gammatone import TURN_SPAN, GammatoneBank
from rosafe.dsp.kernels import build
from rosafe.dsp.numeric_limits import LIMIT
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage
from rosafe.dsp.windows import NAMES
from rosafe.localization import cues, mixture
from rosafe.localization.evidence import EvidenceWindow
from rosafe.representations import STAGES, precedence
from rosafe.representations.amsfeatures import AmsFeatures
from rosafe.representations.crosscorrelation import CrossCorrelation
from rosafe.representations.haircell import METHODS, InnerHairCell
from rosafe.representations.ild import Ild
from rosafe.representations.ratemap import Ratemap
from rosafe.representations.registry import CORE_KINDS
from tests.harness import ROOT
from tests.models import random_model

from . import foreign
from .bare import FloatArray, cut, single
from .implementations import NUMPY, Choice, levels, using

RATE = 16000.0

each_level = pytest.mark.parametrize("level", [2, 3, 4, "aarch64"])
each_native = pytest.mark.parametrize("level", [2, 3, 4])
EXAMPLES = "ROSAFE_TEST_EXAMPLES"  # environment variable: their number; the sanitizers need few, but each takes long
count = int(os.environ.get(EXAMPLES, "10"))
examples = settings(max_examples=count, derandomize=count <= 10, database=None)
block_sizes = st.lists(st.one_of(st.sampled_from([0, 1, 2, 3, 64]), st.integers(0, 400)), min_size=1, max_size=8)


@pytest.fixture(scope="module", autouse=True)
def implementation() -> None:
    """Each test of this module selects the implementation itself."""


def signal(channels: int, samples: int, seed: int = 0) -> FloatArray:
    """Return noise with steps of level and silent parts."""
    rng = np.random.default_rng(seed)
    levels = 10.0 ** rng.integers(-6, 3, samples // 100 + 1)
    levels[rng.random(len(levels)) < 0.2] = 0
    return rng.standard_normal((2, channels, samples)) * np.repeat(levels, 100)[:samples]


def outputs(stage: Stage, blocks: Iterable[FloatArray], turns: Iterable[Choice]) -> list[FloatArray]:
    """Return the outputs of `stage` for `blocks` on alternating implementations."""
    made = []
    for block, level in zip(blocks, turns, strict=False):
        with using(level):
            if isinstance(stage, InnerHairCell) and stage.required_extra:
                made.append(stage.process(block, np.abs(block) + 0.25 * np.abs(np.roll(block, 1))))
            else:
                made.append(single(stage.process(block)))
    return made


def agree(
    got: Iterable[FloatArray], expected: Iterable[FloatArray], tolerance: float = 1e-11, least: float = 1e-140
) -> None:
    """Compare to `tolerance` of the largest number, or of `least`. Squares of less than 1e-154 are 0."""
    got, expected = np.concatenate([*got], axis=-1), np.concatenate([*expected], axis=-1)
    assert got.shape == expected.shape
    largest = np.abs(expected).max(initial=least)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * largest)


def check(
    level: Choice,
    kind: str,
    parameters: dict[str, Any],
    blocks: list[FloatArray],
    given: SignalFormat | float = RATE,
    least: float = 1e-140,
) -> None:
    """Compare the kernels with numpy; also a stage that alternates between both."""
    expected = outputs(STAGES[kind](given, **parameters), blocks, [NUMPY] * len(blocks))
    rounds: list[list[Choice]] = [[level], [level, NUMPY, NUMPY, level]]
    for turns in rounds:
        got = outputs(STAGES[kind](given, **parameters), blocks, turns * len(blocks))
        agree(got, expected, least=least)


# --- the kernels ------------------------------------------------------------------------------------------------


@each_level
@given(
    channels=st.integers(1, 11),
    order=st.one_of(st.integers(1, 9), st.sampled_from([16, 63, 128])),
    width=st.floats(0.05, 20),
    sizes=block_sizes,
    envelopes=st.lists(st.booleans(), min_size=8, max_size=8),
)
@examples
def test_gammatone(
    level: Choice, channels: int, order: int, width: float, sizes: list[int], envelopes: list[bool]
) -> None:
    frequencies = np.geomspace(60.0, 7900.0, channels)
    blocks = [np.ascontiguousarray(block) for block in cut(signal(1, sum(sizes) + 50)[:, 0], [*sizes, 50])]
    made: dict[Choice, list[FloatArray]] = {}
    for choice in (NUMPY, level):
        bank = GammatoneBank(RATE, frequencies, order, width)
        made[choice] = []
        with using(choice):
            for block, with_envelope in zip(blocks, envelopes, strict=False):
                output = np.empty((2, channels, block.shape[-1]))
                envelope = bank.process(block, with_envelope, output)
                made[choice] += [output] if envelope is None else [output, envelope]
    agree(made[level], made[NUMPY])


@each_level
@given(method=st.sampled_from(METHODS), channels=st.integers(1, 11), sizes=block_sizes)
@examples
def test_hair_cell(level: Choice, method: str, channels: int, sizes: list[int]) -> None:
    check(level, "ihc", {"ihc_method": method}, cut(signal(channels, sum(sizes) + 50), [*sizes, 50]))


@each_level
def test_hair_cell_of_rows_with_a_stride_of_whole_pages(level: Choice) -> None:
    for method in METHODS:
        check(level, "ihc", {"ihc_method": method}, cut(signal(11, 1600), [512, 1024, 64]))


def framing(prefix: str) -> st.SearchStrategy[dict[str, Any]]:
    """Draw windows of 2 to 300 samples and hops of 1 to 700."""
    short, long = st.integers(1, 12), st.integers(1, 150)
    return st.fixed_dictionaries(
        {
            f"{prefix}_wname": st.sampled_from(NAMES),
            f"{prefix}_wSizeSec": st.one_of(short, long).map(lambda half: 2 * half / RATE),
            f"{prefix}_hSizeSec": st.one_of(short, long, st.integers(1, 700)).map(lambda hop: hop / RATE),
        }
    )


@each_level
@given(parameters=framing("ild"), channels=st.integers(1, 11), sizes=block_sizes)
@examples
def test_ild(level: Choice, parameters: dict[str, Any], channels: int, sizes: list[int]) -> None:
    check(level, "ild", parameters, cut(signal(channels, sum(sizes) + 500), [*sizes, 300]))


@each_level
@given(
    parameters=framing("rm"),
    scaling=st.sampled_from(["power", "magnitude"]),
    decay=st.floats(1e-5, 10),
    channels=st.integers(1, 11),
    sizes=block_sizes,
)
@examples
def test_ratemap(
    level: Choice, parameters: dict[str, Any], scaling: str, decay: float, channels: int, sizes: list[int]
) -> None:
    parameters = {**parameters, "rm_scaling": scaling, "rm_decaySec": decay}
    check(level, "ratemap", parameters, cut(signal(channels, sum(sizes) + 500), [*sizes, 300]))


@each_level
@given(
    parameters=framing("cc"),
    lag=st.one_of(st.integers(1, 12), st.integers(1, 320)),
    channels=st.integers(1, 6),
    sizes=block_sizes,
)
@examples
def test_cross_correlation(
    level: Choice, parameters: dict[str, Any], lag: int, channels: int, sizes: list[int]
) -> None:
    parameters = {**parameters, "cc_maxDelaySec": (lag - 0.5) / RATE}
    check(level, "crossCorrelation", parameters, cut(signal(channels, sum(sizes) + 500), [*sizes, 300]))


@each_level
@pytest.mark.parametrize(("size", "lag"), [(1024, 3), (1026, 100), (2050, 511), (3000, 400), (5002, 511), (1200, 512)])
def test_cross_correlation_of_long_windows(level: Choice, size: int, lag: int) -> None:
    """Windows of several spans, with up to the maximum number of lags, and just above, where FFT is used."""
    parameters = {"cc_wSizeSec": size / RATE, "cc_hSizeSec": size / 3 / RATE, "cc_maxDelaySec": (lag - 0.5) / RATE}
    check(level, "crossCorrelation", parameters, cut(signal(2, 12000), [5000, 100]))


@each_level
@given(
    tau=st.lists(st.floats(1e-4, 2), min_size=1, max_size=8),
    lim=st.one_of(st.sampled_from([0.0, 1.0, 1.5, 1 / (1 - 1e-5), 10.0, 1e6]), st.floats(1, 50)),
    threshold=st.floats(-300, 60),
    filterbank=st.sampled_from(["gammatone", "drnl"]),
    model=st.sampled_from(["", "", "adt_vandorpschuitman"]),
    channels=st.integers(1, 19),
    sizes=block_sizes,
)
@examples
def test_adaptation(
    level: Choice,
    tau: list[float],
    lim: float,
    threshold: float,
    filterbank: str,
    model: str,
    channels: int,
    sizes: list[int],
) -> None:
    given_signal = SignalFormat(
        RATE, RATE, False, 1, 1, tuple(np.geomspace(50.0, 7000.0, channels).tolist()), filterbank
    )
    parameters = {"adpt_tau": tau, "adpt_lim": lim, "adpt_mindB": threshold, "adpt_model": model}
    blocks = cut(signal(channels, sum(sizes) + 50), [*sizes, 50])
    check(level, "adaptation", parameters, blocks, given_signal, least=100.0)  # silence is 0 except for rounding


@each_level
def test_adaptation_by_many_loops(level: Choice) -> None:
    tau = np.geomspace(0.001, 1.0, 32).tolist()
    for lim in (0.0, 10.0):  # the output is multiplied by 5e9: 1e-11 would be a strict limit
        parameters = {"adpt_tau": tau, "adpt_lim": lim}
        blocks = cut(np.abs(signal(3, 600)), [100, 1, 33])
        expected = outputs(STAGES["adaptation"](RATE, **parameters), blocks, [NUMPY] * len(blocks))
        agree(outputs(STAGES["adaptation"](RATE, **parameters), blocks, [level] * len(blocks)), expected, 1e-6, 100.0)


@each_level
@given(
    parameters=framing("ac"),
    clipping=st.sampled_from(kernels.CLIPPINGS),
    alpha=st.one_of(st.sampled_from([0.0, 0.6, 1.0]), st.floats(0, 1)),
    exponent=st.one_of(st.sampled_from([2.0, 2 / 3, 10.0]), st.floats(0.01, 10)),
    channels=st.integers(1, 6),
    sizes=block_sizes,
)
@examples
def test_autocorrelation(
    level: Choice,
    parameters: dict[str, Any],
    clipping: str,
    alpha: float,
    exponent: float,
    channels: int,
    sizes: list[int],
) -> None:
    if clipping == "sgn":  # spectra with zeros: rounding errors of 0 must not be amplified
        exponent = max(exponent, 1.0)
    parameters = {**parameters, "ac_clipMethod": clipping, "ac_clipAlpha": alpha, "ac_K": exponent}
    check(level, "autocorrelation", parameters, cut(signal(channels, sum(sizes) + 500), [*sizes, 300]))


@each_level
@pytest.mark.parametrize(
    ("size", "exponent"), [(882, 2.0), (960, 0.5), (1024, 2.0), (1026, 0.5), (4096, 0.5), (4098, 2.0)]
)
def test_autocorrelation_of_long_windows(level: Choice, size: int, exponent: float) -> None:
    """Up to the maximum of the kernel, and just above, where scipy is used."""
    parameters = {"ac_wSizeSec": size / RATE, "ac_hSizeSec": size / 3 / RATE, "ac_K": exponent}
    check(level, "autocorrelation", parameters, cut(signal(2, 12000), [5000, 100]))


@each_level
@given(
    parameters=framing("ams"),
    ratio=st.integers(1, 9),
    centres=st.lists(st.floats(0.5, 400), min_size=1, max_size=35),
    channels=st.integers(1, 6),
    sizes=block_sizes,
)
@examples
def test_modulation(
    level: Choice, parameters: dict[str, Any], ratio: int, centres: list[float], channels: int, sizes: list[int]
) -> None:
    parameters = {**parameters, "ams_dsRatio": ratio, "ams_cfHz": centres}
    parameters["ams_wSizeSec"] *= ratio
    parameters["ams_hSizeSec"] *= ratio
    check(level, "amsFeatures", parameters, cut(signal(channels, sum(sizes) + 3000), [*sizes, 900]))


@each_level
@given(parameters=framing("prec"), channels=st.integers(1, 11), sizes=block_sizes, parts=st.integers(1, 3))
@examples
def test_windowed_frames(
    level: Choice, parameters: dict[str, Any], channels: int, sizes: list[int], parts: int
) -> None:
    """Groups of frames in the history, in the block and in both."""
    window = np.random.default_rng(0).standard_normal(round(parameters["prec_wSizeSec"] * RATE))
    framing = FrameGrid(window, round(parameters["prec_hSizeSec"] * RATE))
    with using(NUMPY):  # records addresses of arrays
        buffer, rest = FrameBuffer(), FrameBuffer()
        for block in cut(signal(channels, sum(sizes) + 900), [*sizes, 300]):
            wanted = framing.frames(rest.append(block))
            count = wanted.shape[-2]
            rest.drop(count * framing.hop)
            buffer.begin(block.shape[:-1])
            skip, position = buffer.skip, buffer.position
            history, room = buffer.advance(block.shape[-1], count * framing.hop)
            frames = kernels.FrameReader(
                *(history, np.ascontiguousarray(block), room, skip, kernels.PinnedArray.of(window)),
                *(framing.hop, count, position),
            )
            batch = max(1, count // parts)
            for first in range(0, count, batch):
                number = min(batch, count - first)
                got, expected = (kernels.Windowed.allocate(number, channels, len(window)) for _ in range(2))
                with using(level):
                    kernels.windowed(frames.part(first, number), got)
                precedence.windowed(wanted[:, :, first : first + number], window, expected)
                for mine, theirs in zip(got, expected, strict=True):
                    agree([mine], [theirs])
            frames.save_tail()


@each_level
@given(channels=st.integers(1, 11), frames=st.integers(1, 4), half=st.integers(1, 200), power=st.integers(2, 10))
@examples
def test_summed_spectra(level: Choice, channels: int, frames: int, half: int, power: int) -> None:
    """With any sufficient number of points, and half of the samples or more; previous sums are continued."""
    points = max(1 << power, 1 << (2 * half - 1).bit_length())
    rng = np.random.default_rng(half)
    gains, sums = rng.random(channels), {}
    for choice in (NUMPY, level):
        running = precedence.RunningSums()
        running.begin(np.full(channels, 500.0), points // 2 + 1, 1)
        rng, made = np.random.default_rng(half), []
        with using(choice):
            add = precedence.add_spectra if choice == NUMPY else kernels.add_spectra
            for _ in range(2):
                samples = rng.standard_normal((frames, 2, channels, 2 * half)) * 10 ** rng.uniform(-3, 3)
                factors = np.where(rng.random((frames, 2, channels)) < 0.3, 0, rng.random((frames, 2, channels)))
                made.append(add(samples, points, gains, factors, running.power).T)
        rows = np.arange(2 * channels)
        made.append(running.power[rows // kernels.INTERLEAVED_ROWS, :, rows % kernels.INTERLEAVED_ROWS].T)
        sums[choice] = made
    for got, expected in zip(sums[level], sums[NUMPY], strict=True):
        agree([got], [expected])


@each_level
@given(
    rows=st.integers(1, 11),
    frames=st.integers(1, 4),
    size=st.one_of(st.integers(1, 40), st.integers(900, 1200)),
    reach=st.one_of(st.integers(1, 9), st.sampled_from([45, 200, 511])),
    alike=st.booleans(),
    seed=st.integers(0, 1000),
)
@examples
def test_correlations_of_filtered_frames(
    level: Choice, rows: int, frames: int, size: int, reach: int, alike: bool, seed: int
) -> None:
    """Both kinds of filters, with delays up to more than a frame; some without an echo."""
    rng = np.random.default_rng(seed)
    ears: list[tuple[FloatArray, kernels.Taps]] = []
    made = {}
    for _ in range(2):
        shape = (frames, 1 if alike else rows)
        delays = rng.integers(1, size + 20, shape)[..., np.newaxis]
        large = rng.random((*shape, 1)) < 0.5
        shifts = np.where(large, np.arange(6) - 6, np.arange(6)) * delays
        values = np.where(rng.random((*shape, 6)) < 0.2, 0.0, rng.standard_normal((*shape, 6)))
        samples = rng.standard_normal((frames, 2, rows, size))[:, 0]  # rows that are not contiguous
        ears.append((samples, kernels.Taps(shifts, values)))
    for choice in (NUMPY, level):
        with using(choice):
            correlate = precedence.correlate_filtered if choice == NUMPY else kernels.correlate_filtered
            made[choice] = correlate(*ears[0], *ears[1], reach)
    for got, expected in zip(made[level], made[NUMPY], strict=True):
        agree([got], [expected], least=1.0)  # rounding errors of 0 in numpy are relative to the energies


@each_level
@pytest.mark.parametrize("parameters", [{}, {"prec_maxDelaySec": 0.1}, {"prec_wSizeSec": 0.7}], ids=str)
def test_precedence(level: Choice, parameters: dict[str, Any]) -> None:
    """Also with more lags, or more points of a transform, than the kernels support."""
    rows = 3 if level in foreign.MACHINES else 9  # more than a vector; an emulated processor is slow
    x = np.random.default_rng(1).standard_normal((2, rows, 16000))
    x[1] += np.roll(x[0], 5, axis=-1)
    made = {}
    rounds: list[list[Choice]] = [[NUMPY], [level], [level, NUMPY, NUMPY, level]]
    for turns in rounds:
        stage, blocks = STAGES["precedence"](RATE, **parameters), cut(x, [3000, 1, 200])
        parts = []
        for block, choice in zip(blocks, turns * len(blocks), strict=False):
            with using(choice):
                parts.append(stage.process(np.ascontiguousarray(block)))
        made[len(turns), turns[0]] = [np.concatenate(part, axis=-1) for part in zip(*parts, strict=True)]
    expected = made.pop((1, NUMPY))
    assert expected[0].shape[-1] > 20
    for got in made.values():
        for mine, theirs in zip(got, expected, strict=True):
            agree([mine], [theirs])


@each_level
@given(channels=st.integers(1, 11), sizes=st.lists(st.integers(0, 40), min_size=1, max_size=6))
@examples
def test_gabor(level: Choice, channels: int, sizes: list[int]) -> None:
    """The responses; the rest is the same code. Values of a few standard deviations: see the levels."""
    rng = np.random.default_rng(channels)
    rates = 10.0 ** rng.uniform(-3, 0, (2, channels, sum(sizes) + 60))
    check(level, "gabor", {}, cut(rates, [*sizes, 23]), SignalFormat(44100.0, 100.0, True, 441, 882))


@each_level
@pytest.mark.parametrize(
    "kind",
    ["gammatone", "ihc", "ild", "ratemap", "crossCorrelation", "adaptation", "autocorrelation", "amsFeatures"],
)
def test_far_beyond_sound(level: Choice, kind: str) -> None:
    """Huge samples are clamped in the same way. Kernels may set tiny ones to 0, a negligible difference."""
    for value in (1e300, LIMIT, 1e-160, 5e-324):
        sound = np.sign(signal(3, 2000)) * value
        blocks = cut(sound[:, 0] if kind == "gammatone" else sound, [700, 1, 600])
        expected = np.concatenate(outputs(STAGES[kind](RATE), blocks, [NUMPY] * len(blocks)), axis=-1)
        got = np.concatenate(outputs(STAGES[kind](RATE), blocks, [level] * len(blocks)), axis=-1)
        assert np.isfinite(got).all()
        size = 1.0 if kind == "autocorrelation" else max(min(value, 1.0), np.abs(expected).max())  # has no level
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11 * size, err_msg=str(value))


@each_level
def test_changes_between_blocks(level: Choice) -> None:
    """A new window uses the buffered samples."""
    for stage_class, prefix in ((Ild, "ild"), (Ratemap, "rm"), (CrossCorrelation, "cc"), (AmsFeatures, "ams")):
        made = {}
        for choice in (NUMPY, level):
            stage = stage_class(RATE)
            parts = outputs(stage, cut(signal(3, 1000), 300), [choice] * 4)
            stage.configure(**{f"{prefix}_wSizeSec": 0.03, f"{prefix}_hSizeSec": 0.004, f"{prefix}_wname": "triang"})
            parts += outputs(stage, cut(signal(3, 1000, seed=1), 300), [choice] * 4)
            made[choice] = parts
        agree(made[level], made[NUMPY])


@each_native
def test_denormal_numbers_are_off_inside_kernels_only(level: Choice) -> None:
    """They are off inside kernels; arithmetic outside is unchanged."""
    smallest = np.array([5e-324])
    with using(level):
        for kind in CORE_KINDS:
            STAGES[kind](RATE).process(
                np.ones((2, 100)) if kind in ("input", "preProc", "gammatone") else np.ones((2, 3, 100))
            )
            assert (smallest * 1.0)[0] == 5e-324, kind


@pytest.mark.parametrize("level", [NUMPY, 2, 3, 4])
def test_denormal_numbers_are_off_for_numpy_on_request(level: Choice) -> None:
    smallest = np.array([5e-324])
    with using(level):
        with kernels.denormals_off():
            assert (smallest * 1.0)[0] == (5e-324 if level == NUMPY else 0.0)
        with pytest.raises(ZeroDivisionError), kernels.denormals_off():
            raise ZeroDivisionError
        assert (smallest * 1.0)[0] == 5e-324


@each_native
def test_kernels_release_the_gil(level: Choice) -> None:
    assert any(_steps_meanwhile(level) > 10 for _ in range(10)), "not one step in the middle of a call"


def _steps_meanwhile(level: Choice) -> int:
    """Return the steps of this thread during a call of another thread; few if the system runs other processes."""
    sound = signal(16, 100_000)
    span: list[float] = []
    ready = threading.Event()

    def work() -> None:
        stage = CrossCorrelation(RATE, cc_maxDelaySec=0.02)
        ready.set()
        span.append(time.perf_counter())
        stage.process(sound)
        span.append(time.perf_counter())

    with using(level):
        worker = threading.Thread(target=work)
        worker.start()
        ready.wait()
        ticks = []
        while worker.is_alive():
            ticks.append(time.perf_counter())
        worker.join()
    begin, end = span
    return sum(begin + (end - begin) / 4 < tick < end - (end - begin) / 4 for tick in ticks)


def test_constants_are_those_of_the_sources() -> None:
    sources = {path.name: path.read_text() for path in (ROOT / "rosafe" / "dsp" / "kernels").glob("*.[ch]")}
    assert f"MAX_POLES = {kernels.MAX_POLES} " in sources["gammatone.c"]
    assert f"{{ SPAN = {TURN_SPAN} " in sources["gammatone.c"]
    assert f"MAX_SECTIONS = {kernels.MAX_SECTIONS} " in sources["biquads.c"]
    assert f"MAX_LAGS = {kernels.MAX_LAGS}," in sources["correlation_blocks.h"]
    assert f"MAX_POINTS = {kernels.MAX_POINTS // 2} " in sources["fourier.h"]
    assert f"TAPS = {kernels.TAPS} " in sources["precedence.c"]
    assert f"INTERLEAVED_ROWS = {kernels.INTERLEAVED_ROWS} " in sources["precedence.c"]
    assert f"MAX_LOOPS = {kernels.MAX_LOOPS} " in sources["adaptation.c"]
    assert f"MAX_SIZE = {kernels.MAX_SIZE} " in sources["autocorrelation.c"]
    assert kernels.CLIPPINGS == ("clp", "clc", "sgn")
    assert "{ COMPRESS, CLIP_ONLY, SIGN }" in sources["autocorrelation.c"]
    assert [name.upper().replace("WAVE", "_WAVE") for name in kernels.RECTIFICATIONS] == [
        "NONE",
        "HALF_WAVE",
        "FULL_WAVE",
        "SQUARE",
        "COMPRESSED",
    ]
    assert "{ NONE, HALF_WAVE, FULL_WAVE, SQUARE, COMPRESSED }" in sources["biquads.c"]


def test_the_processor_check_uses_no_newer_instructions() -> None:
    """Otherwise the check itself would be an illegal instruction on an older processor."""
    if not levels():
        pytest.skip("the kernels cannot be built here")
    path = build.libraries()[2]
    try:
        command = ["objdump", "-d", "--no-show-raw-insn", "--disassemble=rosafe_processor_level", str(path)]
        listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except FileNotFoundError:
        pytest.skip("no objdump here")
    instructions = [line.split("\t")[1].split()[0] for line in listing.splitlines() if "\t" in line]
    assert len(instructions) > 3
    newer = {name for name in instructions if name.startswith("v") or name in ("andn", "bextr", "sarx", "shlx", "shrx")}
    assert not newer


def random_cues(frames: int, channels: int, rng: np.random.Generator) -> cues.Cues:
    """Return cues with levels on both sides of those of all classes, and on their limits."""
    first = np.arange(channels) * cues.CLASSES + cues.LEVEL_CLASSES * rng.integers(
        0, cues.COHERENCE_CLASSES, (frames, channels)
    )
    return cues.Cues(
        first * cues.ITD_BINS + rng.integers(0, cues.ITD_BINS, first.shape),
        first * cues.ILD_BINS + rng.integers(0, cues.ILD_BINS, first.shape),
        np.round(rng.uniform(-60, -30, first.shape)),
        rng.random(first.shape) < 0.7,
    )


@each_level
@pytest.mark.parametrize("yaw", [0.0, 37.0, None])
def test_evidence(yaw: float | None, level: Choice) -> None:
    """The sums and the evidence of units are equal to the last bit, with parts of all sizes."""
    rng = np.random.default_rng(1)
    model = random_model(5, rng)
    both = EvidenceWindow(model, 50), EvidenceWindow(model, 50)
    for frames in [1, 1, 3, 10, 10, 30, 10, 1, 10, 60, 10]:
        new = random_cues(frames, 5, rng)
        turned = rng.uniform(-180, 180, frames) if yaw is None else np.full(frames, yaw)
        results = []
        for window, choice in zip(both, (level, NUMPY), strict=True):
            with using(choice):
                window.extend(new, np.ones(frames), turned)
                dry = (window.unit_evidence(20, model.dry, step=step) for step in (1, 3))
                results.append((window.sums(), *window.units(20, np.full(5, -40.0)), *dry))
        for got, expected in zip(*results, strict=True):
            np.testing.assert_array_equal(got, expected)
    assert np.abs(both[0].sums()).max() > 1


@each_level
@pytest.mark.parametrize("units", [1, 60, 1550])
def test_mixture(units: int, level: Choice) -> None:
    rng = np.random.default_rng(units)
    likelihood = np.exp(rng.normal(0, 2, (units, kernels.DIRECTIONS))).astype(np.float32)
    start = rng.uniform(0.5, 1.0, kernels.DIRECTIONS + 1).astype(np.float32)
    start /= start.sum()
    got, expected = start.copy(), start.copy()
    with using(level):
        inverse = kernels.mixture(likelihood, 20, got)
    np.testing.assert_allclose(inverse, mixture.fit_by_numpy(likelihood, 20, expected), rtol=1e-4)
    np.testing.assert_allclose(got, expected, atol=1e-6)
    assert np.abs(expected - start).max() > 5e-3  # it has moved
