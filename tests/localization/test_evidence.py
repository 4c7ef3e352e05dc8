"""The sums of a sliding window are those of its frames alone, for any blocks and any rotation of the head."""

from __future__ import annotations

import numpy as np
import pytest

from rosafe.dsp.kernels import EvidenceTables
from rosafe.localization.cues import CLASSES, ILD_BINS, ITD_BINS, LEVEL_CLASSES, Cues, floors
from rosafe.localization.direction_model import DirectionModel, Histograms
from rosafe.localization.evidence import EvidenceWindow, rotate
from tests.models import random_model

CHANNELS, LENGTH, FRAMES = 3, 40, 170
RANDOM = np.random.default_rng(5)
YAW = {
    "still": np.zeros(FRAMES),
    "turned": np.full(FRAMES, 47.0),
    "turning": np.linspace(-100, 200, FRAMES),
    "then turning": np.r_[np.zeros(90), np.linspace(0, 60, FRAMES - 90)],
}


@pytest.fixture(scope="module")
def model() -> DirectionModel:
    """Return a model whose tables are random."""
    return random_model(CHANNELS, RANDOM)


def random_cues() -> Cues:
    first = np.arange(CHANNELS) * CLASSES
    coherence = LEVEL_CLASSES * RANDOM.integers(0, CLASSES // LEVEL_CLASSES, (FRAMES, CHANNELS))
    rows = ((first + coherence) * bins + RANDOM.integers(0, bins, (FRAMES, CHANNELS)) for bins in (ITD_BINS, ILD_BINS))
    level = RANDOM.uniform(-60, -20, (FRAMES, CHANNELS))
    level[60::25] = -90.0  # the floor changes, and changes again when these frames leave the window
    return Cues(next(rows), next(rows), level, RANDOM.random((FRAMES, CHANNELS)) < 0.8)


def direct_sum(tables: EvidenceTables, model: DirectionModel, cues: Cues, yaw: np.ndarray) -> np.ndarray:
    """Return the sums (C, A) of the frames, each turned alone."""
    itd, ild = model.rows(cues, floors(cues.level))
    terms = (tables.itd[itd] + tables.ild[ild]).astype(np.float64)
    turned = [rotate(frame, np.full(CHANNELS, turn)) for frame, turn in zip(terms, yaw, strict=True)]
    return np.asarray(np.sum(turned, axis=0))


@pytest.mark.parametrize("yaw", YAW.values(), ids=YAW)
@pytest.mark.parametrize("block", [1, 7, 30, 100])
def test_sums_are_those_of_the_frames_in_the_window(model: DirectionModel, block: int, yaw: np.ndarray) -> None:
    cues, window = random_cues(), EvidenceWindow(model, LENGTH)
    tables = window._tables = model.dry if block == 30 else model.rooms
    for begin in range(0, FRAMES, block):
        part = slice(begin, begin + block)
        window.extend(cues.select(part), np.ones(len(yaw[part])), yaw[part])
        end = min(begin + block, FRAMES)
        kept = slice(max(0, end - LENGTH), end)
        expected = direct_sum(tables, model, cues.select(kept), yaw[kept])
        np.testing.assert_allclose(window.sums(), expected, atol=1e-4)  # single precision is turned
    assert np.abs(expected).max() > 10


def test_units_are_compared_with_reverberation(model: DirectionModel) -> None:
    """The last column of the tables, which is that of reverberation, is subtracted; both with the same weights."""
    found, frames = random_cues(), np.arange(3)
    floor = floors(found.level)
    valid = found.valid[frames]
    itd, ild = (rows[valid] for rows in model.rows(found.select(frames), floor))
    for exponent in (1.0, 0.0):
        weighted = model.rooms.itd[itd] + model.rooms.ild[ild]
        terms = weighted if exponent else model.unweighted_terms(itd, ild)
        units = model.unit_evidence(model.rooms, found, floor, frames, exponent)
        late = terms - units
        assert np.ptp(late, axis=1).max() < 1e-4 * np.abs(terms).max() and np.abs(late).mean() > 0.1
        dry, compared = (
            model.unit_evidence(tables, found, floor, frames, exponent) for tables in (model.dry, model.dry_or_late)
        )
        assert np.ptp(dry - compared, axis=1).max() < 1e-4 * np.abs(dry).max() < np.abs(dry - units).max()


def test_reverberation_does_not_change_the_tables_of_directions() -> None:
    """It has another distribution: that of its own frames."""
    histograms = Histograms(CHANNELS, 2)
    frequencies = np.linspace(100.0, 4000.0, CHANNELS)
    histograms.add(0, random_cues())
    histograms.add(1, random_cues(), in_room=True)
    before = histograms.tables(frequencies)
    assert all(np.abs(table[:, -1]).max() < 1e-4 for table in before)  # that of the mean
    histograms.add(None, random_cues())
    for table, without in zip(histograms.tables(frequencies), before, strict=True):
        np.testing.assert_array_equal(table[:, :-1], without[:, :-1])
        assert np.abs(table[:-1, -1]).mean() > 0.01


def test_half_of_the_dry_tables_is_of_sounds_without_a_room() -> None:
    first, second = random_cues(), random_cues()
    frequencies = np.linspace(100.0, 4000.0, CHANNELS)

    def tables(*sounds: tuple[Cues, bool]) -> list[np.ndarray]:
        histograms = Histograms(CHANNELS, 2)
        for found, in_room in sounds:
            histograms.add(0, found, in_room)
            histograms.add(1, found._replace(level=found.level[::-1]), in_room)
        return histograms.tables(frequencies)

    alone, both = tables((first, False)), tables((first, False), (second, True))
    for found, dry, all_ in zip(both[2:], alone[:2], both[:2], strict=True):
        np.testing.assert_allclose(found, (dry + all_) / 2, atol=1e-6)
    assert np.abs(both[0] - alone[0]).max() > 0.01


@pytest.mark.parametrize("phase", range(10))
def test_the_lowest_level_is_found_at_any_phase(model: DirectionModel, phase: int) -> None:
    """A pause of 10 frames counts whole, however the updates after every 10 frames lie."""
    cues, window = random_cues(), EvidenceWindow(model, LENGTH)
    cues = cues._replace(level=np.tile(np.repeat([-20.0, -25.0, -60.0, -22.0], 10)[:, np.newaxis], (1, CHANNELS)))
    found = []
    for begin in range(phase, 31, 10):
        part = slice(begin, begin + 10)
        window.extend(cues.select(part), np.zeros(len(cues.level[part])), np.zeros(len(cues.level[part])))
        found.append(window.lowest_level(10))
    assert np.min(found, axis=0) == pytest.approx(-60.0)
