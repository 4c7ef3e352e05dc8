"""Onset and offset maps: the algorithm in plain Python, and changes between blocks."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosafe.dsp.signal_format import SignalFormat
from rosafe.representations.onset_offset_maps import MIN_HISTORY_FRAMES, OffsetMap, OnsetMap
from tests.dsp.implementations import NUMPY, Choice, using

from .chain import Chain, FloatArray

GIVEN = SignalFormat(16000.0, 100.0, True, 160, 320, (200.0, 500.0, 1200.0, 3000.0), "gammatone")
DEFAULTS = {"trm_minStrengthdB": 3.0, "trm_minSpread": 5, "trm_fuseWithinSec": 0.03, "trm_minValuedB": -2000.0}


# --- the algorithm, step by step --------------------------------------------------------------------------------


def peaks_of(x: Sequence[float]) -> list[int]:
    found = []
    for start in range(1, len(x)):
        stop = start
        while stop + 1 < len(x) and x[stop + 1] == x[start]:
            stop += 1
        if x[start - 1] < x[start] and stop + 1 < len(x) and x[stop + 1] < x[start]:
            found.append((start + stop) // 2)
    return found


def offline(strengths: FloatArray, levels: FloatArray, values: dict[str, Any], rate: float) -> FloatArray:
    """Return the units (C, n) of a segment that remain."""
    q = math.floor(values["trm_fuseWithinSec"] * rate + 0.5)
    units = set()
    for channel, (of_channel, level) in enumerate(zip(strengths, levels, strict=True)):
        x = [
            s if s >= values["trm_minStrengthdB"] and v >= values["trm_minValuedB"] else 0.0
            for s, v in zip(of_channel.tolist(), level.tolist(), strict=True)
        ]
        stay: list[int] = []
        for peak in sorted(peaks_of(x), key=lambda at: (-x[at], at)):
            if q <= 2 or all(abs(peak - other) >= q for other in stay):
                stay.append(peak)
        units |= {(channel, at) for at in stay}
    result = np.zeros(strengths.shape)
    while units:
        fragment, found = [], [units.pop()]
        while found:
            channel, at = found.pop()
            fragment.append((channel, at))
            near = {(channel + i, at + j) for i in (-1, 0, 1) for j in (-1, 0, 1)} & units
            units -= near
            found += near
        if len(fragment) >= values["trm_minSpread"]:
            for unit in fragment:
                result[unit] = 1
    return result


def reach_of(values: dict[str, Any], rate: float) -> int:
    return 2 * math.floor(values["trm_fuseWithinSec"] * rate + 0.5) + values["trm_minSpread"] - 1


def column(strengths: FloatArray, levels: FloatArray, values: dict[str, Any], rate: float, k: int) -> FloatArray:
    """Compute frame k of the map of one ear."""
    reach = reach_of(values, rate)
    first = max(0, k - reach)
    segment = slice(first, k + reach + 1)
    return offline(strengths[:, segment], levels[:, segment], values, rate)[:, k - first]


def by_definition(
    strengths: FloatArray,
    levels: FloatArray,
    values: dict[str, Any],
    sizes: Sequence[int],
    changes: Sequence[tuple[int, str, Any]] = (),
    rate: float = 100.0,
) -> FloatArray:
    """Compute the map of both ears; a change applies to later output frames."""
    values, come = dict(values), 0
    made: list[list[FloatArray]] = []
    for index, size in enumerate(sizes):
        values.update({name: value for block, name, value in changes if block == index})
        come += size
        while len(made) + reach_of(values, rate) < come:
            made.append([column(strengths[ear], levels[ear], values, rate, len(made)) for ear in range(2)])
    return np.moveaxis(np.array(made).reshape(len(made), *strengths.shape[:2]), 0, -1)


def run(
    strengths: FloatArray,
    levels: FloatArray,
    values: dict[str, Any],
    sizes: Sequence[int],
    changes: Sequence[tuple[int, str, Any]] = (),
    given_signal: SignalFormat = GIVEN,
) -> FloatArray:
    """Return the output of the stage."""
    stage, made, at = OnsetMap(given_signal, **values), [], 0
    for index, size in enumerate(sizes):
        for _, name, value in (change for change in changes if change[0] == index):
            stage.configure(**{name: value})
        made.append(stage.process(strengths[..., at : at + size], levels[..., at : at + size]))
        at += size
    return np.concatenate(made, axis=-1)


def world(frames: int, seed: int, channels: int = 4) -> tuple[FloatArray, FloatArray]:
    """Return strengths and levels of few different values, with many plateaus and ties."""
    rng = np.random.default_rng(seed)
    strengths = rng.integers(0, 7, (2, channels, frames)) * rng.integers(0, 2, (2, 1, frames))
    return np.minimum(strengths, 5.0), rng.choice([-90.0, -60.0, -30.0, -2000.0], (2, channels, frames))


# --- the reference ----------------------------------------------------------------------------------------------


parameters = st.fixed_dictionaries(
    {
        "trm_minStrengthdB": st.sampled_from([0.0, 1.0, 2.5]),
        "trm_minSpread": st.integers(1, 6),
        "trm_fuseWithinSec": st.sampled_from([0.0, 0.01, 0.015, 0.02, 0.024, 0.025, 0.03, 0.07]),
        "trm_minValuedB": st.sampled_from([-2000.0, -60.0, -59.9]),
    }
)
block_sizes = st.lists(st.one_of(st.sampled_from([0, 1]), st.integers(0, 25)), min_size=1, max_size=6)
changes = st.lists(
    st.one_of(
        st.tuples(st.integers(0, 5), st.just("trm_minStrengthdB"), st.sampled_from([0.0, 3.0])),
        st.tuples(st.integers(0, 5), st.just("trm_minSpread"), st.integers(1, 9)),
        st.tuples(st.integers(0, 5), st.just("trm_fuseWithinSec"), st.sampled_from([0.0, 0.02, 0.03, 0.1])),
        st.tuples(st.integers(0, 5), st.just("trm_minValuedB"), st.sampled_from([-2000.0, -60.0])),
    ),
    max_size=3,
)


@settings(max_examples=150)
@given(parameters, st.integers(0, 99), block_sizes, changes, st.integers(1, 5))
def test_the_algorithm_in_plain_python(
    values: dict[str, Any], seed: int, sizes: list[int], changes: list[tuple[int, str, Any]], channels: int
) -> None:
    """With any parameters, blocks, and changes between blocks."""
    strengths, levels = world(sum(sizes), seed, channels)
    np.testing.assert_array_equal(
        run(strengths, levels, values, sizes, changes), by_definition(strengths, levels, values, sizes, changes)
    )


@pytest.mark.parametrize("kind", ["onsetMap", "offsetMap"])
def test_sparse_events_are_those_of_the_whole_signal(kind: str) -> None:
    """Without long chains of conflicts, the windows have no effect."""
    rng = np.random.default_rng(1)
    strengths = np.zeros((2, 12, 300))
    for at in range(20, 290, 23):
        strengths[:, :, at - 3 : at + 3] += rng.uniform(0, 12, (2, 12, 6))
    levels = np.zeros(strengths.shape)
    stage = {"onsetMap": OnsetMap, "offsetMap": OffsetMap}[kind](GIVEN)
    made = stage.process(strengths, levels)
    assert made.shape[-1] == 290
    assert made.sum() > 50
    for ear in range(2):
        np.testing.assert_array_equal(made[ear], offline(strengths[ear], levels[ear], DEFAULTS, 100.0)[:, :290])


# --- maps drawn as text ----------------------------------------------------------------------------------------------


def marks(rows: list[str], **values: Any) -> list[str]:
    """Return the map of strengths drawn as digits. By default all peaks within 4 frames remain."""
    values = {"trm_minStrengthdB": 1.0, "trm_minSpread": 1, "trm_fuseWithinSec": 0.02, **values}
    stage = OnsetMap(GIVEN, **values)
    one = np.array([[float(character) for character in row + "0" * stage.look_ahead] for row in rows])
    block = np.stack([one, np.zeros(one.shape)])
    made = stage.process(block, np.zeros(block.shape))
    assert not made[1].any()
    return ["".join(".#"[int(unit)] for unit in row) for row in made[0]]


def test_peaks() -> None:
    assert marks(["012321"]) == ["...#.."]
    assert marks(["03300444403333300"]) == [".#....#.....#...."]  # plateaus: the middle, rounded down
    assert marks(["0333333333330"]) == ["............."]  # no plateau longer than the segment
    assert marks(["550001"]) == [".....#"]  # the first frame is not a peak
    assert marks(["0202030100"], trm_minStrengthdB=2.0) == [".#.#.#...."]


def test_fusing() -> None:
    assert marks(["0102030201"]) == [".#.#.#.#.#"]  # 2 frames: all remain
    # in order of strength: removed peaks claim nothing
    assert marks(["0102030201"], trm_fuseWithinSec=0.03) == [".#...#...#"]
    assert marks(["0101010"], trm_fuseWithinSec=0.03) == [".#...#."]  # the earlier of equals
    assert marks(["010010"], trm_fuseWithinSec=0.03) == [".#..#."]  # 3 frames apart
    assert marks(["01010"], trm_fuseWithinSec=0.03) == [".#..."]


def test_fragments() -> None:
    rows = ["00200000000002000000", "00020000020000000000", "00002000000000000000", "00000000000000002020"]
    expected = ["..#.................", "...#................", "....#...............", "...................."]
    assert marks(rows, trm_minSpread=3) == expected
    assert marks(rows, trm_minSpread=4) == ["." * 20] * 4
    tall = ["00020000"] * 4
    assert marks(tall, trm_minSpread=4) == ["...#...."] * 4  # units, not channels
    assert marks(tall, trm_minSpread=5) == ["........"] * 4


def test_a_fragment_may_have_any_shape() -> None:
    """The units that make it large enough are as far away as possible."""
    rows = ["0" * k + "2" + "0" * (9 - k) for k in (3, 4, 5, 6, 7)]
    assert marks(rows, trm_minSpread=5) == [row.replace("0", ".").replace("2", "#") for row in rows]
    assert not any("#" in row for row in marks(rows, trm_minSpread=6))


def test_a_single_frame_has_no_peak() -> None:
    """With a look-ahead of 0, by its formula."""
    assert marks(["0202030100"], trm_fuseWithinSec=0.0) == [".........."]
    assert marks(["0202030100"] * 2, trm_fuseWithinSec=0.0, trm_minSpread=2) == [".#.#.#.#.."] * 2


# --- looking ahead ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "rate", "expected"),
    [
        ({}, 100.0, 10),
        ({"trm_fuseWithinSec": 0.025}, 100.0, 10),  # 2.5 is 3
        ({"trm_fuseWithinSec": 0.0249}, 100.0, 8),
        ({"trm_fuseWithinSec": 0.0, "trm_minSpread": 1}, 100.0, 0),
        ({}, 50.0, 8),
        ({"trm_fuseWithinSec": 10.0, "trm_minSpread": 1024}, 100.0, 3023),
    ],
)
def test_look_ahead(values: dict[str, Any], rate: float, expected: int) -> None:
    stage = OnsetMap(replace(GIVEN, rate=rate), **values)
    assert stage.look_ahead == expected
    assert [stage.output_count(expected + more) for more in (-1, 0, 1, 5)] == [0, 0, 1, 5]


def test_the_next_frame_follows_the_last_output() -> None:
    """A shorter look-ahead outputs several frames at once, a longer one none for some time."""
    strengths, levels = world(60, 3)
    stage = OnsetMap(GIVEN)
    assert stage.process(strengths[..., :30], levels[..., :30]).shape[-1] == 20
    stage.configure(trm_minSpread=1)
    assert stage.process(strengths[..., :0], levels[..., :0]).shape[-1] == 4
    stage.configure(trm_fuseWithinSec=0.1)  # 20
    assert stage.process(strengths[..., 30:44], levels[..., 30:44]).shape[-1] == 0
    assert stage.process(strengths[..., 44:45], levels[..., 44:45]).shape[-1] == 1


def test_a_longer_window_uses_frames_of_the_past() -> None:
    size = MIN_HISTORY_FRAMES + 300
    strengths, levels = world(2 * size, 5, channels=1)
    before: dict[str, Any] = {**DEFAULTS, "trm_minSpread": 1}
    after = {**before, "trm_fuseWithinSec": 1.2, "trm_minValuedB": -60.0}
    changes = [(1, name, after[name]) for name in ("trm_fuseWithinSec", "trm_minValuedB")]
    got = run(strengths, levels, before, [size, size], changes)
    assert got.shape[-1] == 2 * size - 240
    first = size - 6
    for k in (first, first + 1, first + 100):
        expected = column(strengths[0], levels[0], after, 100.0, k)
        np.testing.assert_array_equal(got[0, :, k], expected)


def test_other_steps_of_the_parent() -> None:
    """q and H follow the rate; frames in the buffer are kept."""
    strengths, levels = world(60, 6)
    values = {**DEFAULTS, "trm_minSpread": 2, "trm_minStrengthdB": 1.0, "trm_fuseWithinSec": 0.05}  # H 11
    stage = OnsetMap(GIVEN, **values)
    first = stage.process(strengths[..., :30], levels[..., :30])
    assert first.shape[-1] == 19
    stage.set_input_format(replace(GIVEN, rate=60.0, hop=267))  # q 3, H 7
    assert stage.look_ahead == 7
    assert stage.output_format.rate == 60.0
    rest = stage.process(strengths[..., 30:], levels[..., 30:])
    assert rest.shape[-1] == 34
    for k in range(19, 53):
        expected = column(strengths[0], levels[0], values, 60.0, k)
        np.testing.assert_array_equal(rest[0, :, k - 19], expected)


# --- the level --------------------------------------------------------------------------------------------------


def test_the_level_of_the_ratemap() -> None:
    """From the ratemap to the map; units below trm_minValuedB are ignored, also if the limit is set later."""
    rng = np.random.default_rng(8)
    rates = 10 ** rng.uniform(-8, -2, (2, 4, 80))
    settings_ = {"trm_minSpread": 1, "trm_fuseWithinSec": 0.02, "trm_minStrengthdB": 1.0}
    free = Chain(GIVEN, ["onsetMap"], settings_, root="onsetStrength").run(rates, 9)["onsetMap"]
    chain = Chain(GIVEN, ["onsetMap", "onsetStrength"], {**settings_, "trm_minValuedB": -40.0}, root="onsetStrength")
    made = chain.run(rates, 9)
    loud = 10 * np.log10(rates) >= -40
    strengths = np.where(loud, made["onsetStrength"], 0.0)
    expected = run(strengths, np.zeros(strengths.shape), {**DEFAULTS, **settings_}, [80])
    np.testing.assert_array_equal(made["onsetMap"], expected)
    assert (expected < free).any()
    late = Chain(GIVEN, ["onsetMap"], settings_, root="onsetStrength")
    got = late.run(rates, 40, [(1, "trm_minValuedB", -40.0)])["onsetMap"]
    np.testing.assert_array_equal(got, np.concatenate([free[..., :36], expected[..., 36:]], axis=-1))


@pytest.mark.parametrize("extra", [None, np.zeros((2, 4, 6)), np.zeros((2, 3, 7)), np.zeros((4, 7))])
def test_a_block_without_its_level(extra: Any) -> None:
    stage = OnsetMap(GIVEN)
    assert stage.required_extra == "level"
    with pytest.raises(ValueError, match=r"^level: "):
        stage.process(np.zeros((2, 4, 7)), extra)


# --- kernel and numpy --------------------------------------------------------------------------------------------


VALUES: list[dict[str, Any]] = [
    {},
    {"trm_minSpread": 10, "trm_fuseWithinSec": 0.0, "trm_minStrengthdB": 0.0},
    {"trm_minSpread": 3, "trm_fuseWithinSec": 0.4},
    {"trm_minSpread": 1, "trm_fuseWithinSec": 0.04, "trm_minValuedB": -60.0},
    {"trm_minSpread": 1024},
]


@functools.cache
def by(implementation: Choice, number: int, ties: bool) -> FloatArray:
    """Return the output of one implementation for `VALUES[number]`."""
    if ties:
        strengths, levels = world(400, 9, channels=12)
    else:
        rng = np.random.default_rng(10)
        strengths, levels = rng.uniform(0, 20, (2, 12, 400)), rng.uniform(-90, 0, (2, 12, 400))
    with using(implementation):
        return run(strengths, levels, VALUES[number], [150, 1, 0, 3, 200, 46])


@pytest.mark.parametrize("level", [2, 3, 4, "aarch64"])
@pytest.mark.parametrize("number", range(len(VALUES)))
@pytest.mark.parametrize("ties", [True, False])
def test_the_kernel_equals_the_numpy_implementation(level: Choice, number: int, ties: bool) -> None:
    expected = by(NUMPY, number, ties)
    np.testing.assert_array_equal(by(level, number, ties), expected)
    if VALUES[number].get("trm_minSpread") != 1024:
        assert 0 < expected.mean() < 0.5


# --- invalid values ---------------------------------------------------------------------------------------------------


def test_too_many_frames() -> None:
    with pytest.raises(ValueError, match=r"^trm_fuseWithinSec: expected at most 2147483647 samples, got 1e\+10"):
        OnsetMap(replace(GIVEN, rate=1e9), trm_fuseWithinSec=10.0)
    stage = OnsetMap(GIVEN, trm_fuseWithinSec=10.0)
    with pytest.raises(ValueError, match=r"^trm_fuseWithinSec: expected at most 2147483647 samples, got 1e\+10"):
        stage.set_input_format(replace(GIVEN, rate=1e9))
    assert stage.output_format.rate == 100.0
