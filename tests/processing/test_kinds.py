"""Outputs of any kind: names, shapes, coordinates and rates follow from the declaration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.declarations.parameter import Parameter
from rosafe.declarations.representation import Derived, Part, Representation
from rosafe.dsp.framing import FramedStage, frame_parameters
from rosafe.dsp.numeric_limits import FloatArray, clamp
from rosafe.dsp.stage import Output
from rosafe.interface import arguments
from rosafe.representations import KINDS, STAGES
from tests.dsp.bare import cut

RATE = 16000.0
FEW = {"fb_nChannels": 4, "fb_highFreqHz": 4000.0}
SOUND = 0.1 * np.random.default_rng(0).standard_normal((2, 3000))


class Shells(FramedStage):
    """Sums of both ears in each frame, and multiples of them along a centred axis of variable length."""

    REPRESENTATION = Representation(
        kind="shells",
        doc="A test's own",
        parent="preProc",
        parts=(Part("sums", ("time",)), Part("around", ("ear", "lag", "time"))),
        parameters=(*frame_parameters("sh"), Parameter("sh_reach", "unsigned long", 1, "Shells", 0, 10)),
        derived=(Derived("sh_shells", "sequence<double>", "From the middle"),),
        coordinates=("sh_shells",),
        centred="lag",
    )
    prefix = "sh"
    INPUT = ("ear", "time")

    @property
    def derived(self) -> dict[str, Any]:
        return {"sh_shells": self.shells.tolist()}

    @property
    def shells(self) -> FloatArray:
        return np.arange(-self.values["sh_reach"], self.values["sh_reach"] + 1.0)

    def part_rows(self, rows: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        return ((), (2, len(self.shells)))

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return ()

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> Output:
        frames = self._framing.frames(self._buffer.append(clamp(self._as_valid_block(block)))).sum(axis=-1)
        self._buffer.drop(frames.shape[-1] * self._framing.hop)
        return frames.sum(axis=0), frames[:, np.newaxis] * self.shells[:, np.newaxis]


@pytest.fixture
def shells(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(KINDS, "shells", Shells.REPRESENTATION)
    monkeypatch.setitem(STAGES, "shells", Shells)
    yield


def test_an_entry_for_each_part(shells: None) -> None:
    got = rosafe.process(SOUND, RATE, block_frames=700, outputs=["shells"])
    assert list(got) == ["shells_sums", "shells_around", "shells_time", "sh_shells", "shells_frameRate"]
    assert {name: np.shape(value) for name, value in got.items()} == {
        "shells_sums": (17,),
        "shells_around": (2, 3, 17),
        "shells_time": (17,),
        "sh_shells": (3,),
        "shells_frameRate": (),
    }
    np.testing.assert_allclose(got["shells_around"][:, 2].sum(axis=0), got["shells_sums"], rtol=0, atol=1e-12)


def test_parts_that_grow_on_the_way(shells: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Outputs are aligned at the middle of the declared axis; other parts do not change."""
    monkeypatch.setitem(arguments._BY_NAME, "sh_reach", Shells.REPRESENTATION.parameter("sh_reach"))
    whole = rosafe.process(SOUND, RATE, block_frames=1000, outputs=["shells"])
    got = rosafe.process(
        SOUND,
        RATE,
        parameters=None,
        block_frames=1000,
        modifications=[(1, "sh_reach", 3), (2, "sh_reach", 2)],
        outputs=["shells"],
    )
    np.testing.assert_array_equal(got["sh_shells"], np.arange(-3, 4))
    np.testing.assert_array_equal(got["shells_sums"], whole["shells_sums"])
    around = got["shells_around"]
    assert around.shape == (2, 7, 17)
    np.testing.assert_array_equal(around[:, 4], whole["shells_around"][:, 2])
    reaches = [np.flatnonzero(around[0, :, frame]).tolist() for frame in range(17)]
    assert reaches == [[2, 4]] * 5 + [[0, 1, 2, 4, 5, 6]] * 6 + [[1, 2, 4, 5]] * 6


def test_coordinates_are_those_in_effect() -> None:
    """Coordinates before a change at the first block, and after one beyond the end, do not appear."""
    for changes, reach in (
        ([(0, "cc_maxDelaySec", 0.0005)], 8),
        ([(0, "cc_maxDelaySec", 0.003), (0, "cc_maxDelaySec", 0.0005)], 8),
        ([(1, "cc_maxDelaySec", 0.0005)], 18),
        ([(3, "cc_maxDelaySec", 0.003)], 18),
        ([(2, "cc_maxDelaySec", 0.003), (2, "cc_maxDelaySec", 0.0005)], 18),
        ([(1, "cc_maxDelaySec", 0.002), (2, "cc_maxDelaySec", 0.0005)], 32),
    ):
        got = rosafe.process(
            SOUND, RATE, parameters=FEW, block_frames=1000, modifications=changes, outputs=["crossCorrelation"]
        )
        np.testing.assert_allclose(got["cc_lags"], np.arange(-reach, reach + 1) / RATE, err_msg=str(changes))
        assert got["crossCorrelation"].shape[1] == 2 * reach + 1


def test_blocks_without_frames_have_rows_too() -> None:
    """The first block is shorter than a window, and has more lags than the following ones."""
    changes = [(1, "cc_maxDelaySec", 0.0005)]
    got = rosafe.process(
        SOUND, RATE, parameters=FEW, block_frames=[100, 2900], modifications=changes, outputs=["crossCorrelation"]
    )
    assert got["crossCorrelation"].shape == (4, 37, 17)
    np.testing.assert_allclose(got["cc_lags"], np.arange(-18, 19) / RATE)
    assert not got["crossCorrelation"][:, :10].any()


def test_names_are_a_list() -> None:
    got = rosafe.process(
        SOUND, RATE, parameters={**FEW, "sf_requests": ["flux", "centroid"]}, outputs=["spectralFeatures"]
    )
    assert got["sf_requests"] == ["flux", "centroid"]


def test_lags_that_are_not_centred_are_aligned_at_the_first() -> None:
    changes = [(1, "ac_wSizeSec", 0.01), (2, "ac_wSizeSec", 0.03)]
    got = rosafe.process(
        SOUND, RATE, parameters=FEW, block_frames=1000, modifications=changes, outputs=["autocorrelation"]
    )
    assert got["autocorrelation"].shape[:3] == (2, 4, 479)
    np.testing.assert_allclose(got["ac_lags"], np.arange(479) / RATE)
    stage = STAGES["autocorrelation"](STAGES["ihc"](RATE).output_format)
    ihc = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=1000, outputs=["ihc"])["ihc"]
    at = 0
    for number, block in enumerate(cut(ihc, 1000)):
        for name, value in [(name, value) for when, name, value in changes if when == number]:
            stage.configure(**{name: value})
        wanted = stage.process(block)
        assert isinstance(wanted, np.ndarray)
        part = got["autocorrelation"][..., at : at + wanted.shape[-1]]
        np.testing.assert_array_equal(part[:, :, : wanted.shape[2]], wanted)
        assert not part[:, :, wanted.shape[2] :].any()
        at += wanted.shape[-1]
    assert at == got["autocorrelation"].shape[-1]


def test_a_change_that_a_child_cannot_follow_is_refused() -> None:
    """Pitch needs three lags in its range; a change of the autocorrelation would leave fewer."""
    changed: dict[str, Any] = {"parameters": FEW, "block_frames": 1000, "modifications": [(1, "ac_wSizeSec", 0.0005)]}
    with pytest.raises(
        ValueError, match="pi_rangeHz: expected at least 3 lags of the autocorrelation, got 0 from 80 to 400 Hz"
    ):
        rosafe.process(SOUND, RATE, **changed, outputs=["pitch"])
    rosafe.process(SOUND, RATE, **changed, outputs=["autocorrelation"])
