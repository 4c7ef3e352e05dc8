"""Stages that write into the result array: the same numbers without a copy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rosafe
from rosafe.dsp import kernels
from rosafe.processing.process import OutputCollector
from rosafe.representations import STAGES
from rosafe.representations.haircell import METHODS, InnerHairCell
from tests.dsp.bare import cut
from tests.representations.chain import core_chain

pytestmark = [
    pytest.mark.skipif(not kernels.compiled(), reason="numpy's twin of the hair cell's kernel returns its own"),
    pytest.mark.usefixtures("blocks_not_merged"),
]

RATE = 16000.0
BLOCKS = ([3000], [512], [1], [700, 1, 333])
FEW = {"fb_nChannels": 5, "fb_highFreqHz": 4000.0}
SOUND = 0.1 * np.random.default_rng(2).standard_normal((2, 3000))


@pytest.fixture
def copied(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Record the lengths of the blocks that were copied into a result."""
    counts: list[int] = []
    add = OutputCollector.add

    def count(self: OutputCollector, block: np.ndarray) -> None:
        if block is not self._output_slice:
            counts.append(block.shape[-1])
        add(self, block)

    monkeypatch.setattr(OutputCollector, "add", count)
    return counts


@pytest.mark.parametrize("block", [[3000], [512], [1], [700, 1, 333], [1024, 1023]])
@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("gammatone", {}),
        ("gammatone", {"fb_nGamma": 7, "fb_nChannels": 1}),
        ("gammatone", {"fb_type": "drnl"}),
        ("ihc", {}),
        ("ihc", {"ihc_method": "bernstein"}),
        ("ihc", {"ihc_method": "breebart"}),
        ("ihc", {"ihc_method": "none"}),
    ],
)
def test_the_same_numbers_without_a_copy(
    kind: str, parameters: dict[str, Any], block: list[int], copied: list[int]
) -> None:
    sound = SOUND[:, :200] if block == [1] else SOUND
    got = rosafe.process(sound, RATE, parameters={**FEW, **parameters}, block_frames=block, outputs=[kind])[kind]
    assert copied == []
    outputs = core_chain(RATE, {"in_doNormalize": False, **FEW, **parameters}).blocks(cut(sound, block))
    np.testing.assert_array_equal(got, np.concatenate([output[kind] for output in outputs], axis=-1))


def test_outputs_with_children_are_copied(copied: list[int]) -> None:
    """Children need contiguous blocks."""
    alone = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=1000, outputs=["gammatone"])
    assert copied == []
    both = rosafe.process(SOUND, RATE, parameters=FEW, block_frames=1000, outputs=["gammatone", "ihc"])
    assert copied == [1000] * 3
    np.testing.assert_array_equal(both["gammatone"], alone["gammatone"])


def test_a_change_of_the_rows_ends_writing_in_place(copied: list[int]) -> None:
    changes = [(2, "fb_nChannels", 3), (3, "fb_nChannels", 5)]
    options: dict[str, Any] = {"block_frames": 600, "modifications": changes, "outputs": ["gammatone"]}
    got = rosafe.process(SOUND, RATE, parameters=FEW, **options)["gammatone"]
    assert copied == [600] * 3
    outputs = core_chain(RATE, {"in_doNormalize": False, **FEW}).blocks(cut(SOUND, 600), changes)
    for number, output in enumerate(outputs):
        part = got[..., 600 * number : 600 * (number + 1)]
        channels = output["gammatone"].shape[1]
        np.testing.assert_array_equal(part[:, :channels], output["gammatone"])
        assert not part[:, channels:].any()


@pytest.mark.parametrize("kind", ["gammatone", "ihc"])
@pytest.mark.parametrize("frames", [1, 40, 512, 700])
def test_a_place_is_used_only_if_it_fits(kind: str, frames: int) -> None:
    """A place is used for one block if its rows are evenly spaced and contiguous, with the right shape and type."""
    block = np.random.default_rng(frames).standard_normal((2, frames) if kind == "gammatone" else (2, 5, frames))
    parameters = FEW if kind == "gammatone" else {}
    plain = STAGES[kind](RATE, **parameters).process(block)
    for length in (frames, frames + 1, frames + 512, 2048):
        whole = np.full((2, 5, length), np.nan)
        stage = STAGES[kind](RATE, **parameters)
        assert np.shares_memory(stage.process(block, out=whole[..., length - frames :]), whole)
        np.testing.assert_array_equal(whole[..., length - frames :], plain)
        assert np.isnan(whole[..., : length - frames]).all()
        before = whole.copy()
        assert not np.shares_memory(stage.process(block), whole)
        np.testing.assert_array_equal(whole, before)
    whole = np.full((2, 9, 2 * frames), np.nan)
    unfit: list[Any] = [
        whole[:, :4, :frames],
        whole[:, :5, : frames + 1],
        whole[:, :5, :frames] if frames > 1 else whole[:, 4::-1, :1],  # ears another distance apart than channels
        whole[:, :5, ::2] if frames > 1 else whole[:, ::2, :1],
        whole[:, :5, :frames].astype(np.float32),
    ]
    for place in unfit:
        stage = STAGES[kind](RATE, **parameters)
        np.testing.assert_array_equal(stage.process(block, out=place), plain)
        assert np.isnan(whole).all()


@pytest.fixture
def overwritten(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Record for each block whether the hair cell has overwritten its input."""
    seen: list[bool] = []
    process = InnerHairCell.process

    def watch(
        self: InnerHairCell, block: np.ndarray, extra: np.ndarray | None = None, out: np.ndarray | None = None
    ) -> np.ndarray:
        output = process(self, block, extra, out)
        seen.append(np.shares_memory(output, block))
        return output

    monkeypatch.setattr(InnerHairCell, "process", watch)
    return seen


@pytest.mark.parametrize(
    ("method", "kind", "block"),
    [  # each kind of filterbank with all methods and with all blocks
        (method, kind, BLOCKS[number % len(BLOCKS)])
        for kind in ("gammatone", "drnl")
        for number, method in enumerate(METHODS)
    ],
    ids=str,
)
def test_inputs_without_other_consumers_are_overwritten(
    method: str, kind: str, block: list[int], overwritten: list[bool]
) -> None:
    """`process` and `Stream` return the same numbers, and the signal remains unchanged."""
    sound, parameters = SOUND[:, :200] if block == [1] else SOUND, {**FEW, "fb_type": kind, "ihc_method": method}
    given, parts = sound.copy(), cut(sound, block)
    outputs = core_chain(RATE, {"in_doNormalize": False, **parameters}).blocks(parts)
    assert not any(overwritten)
    overwritten.clear()
    wanted = ["ild", "ratemap", "crossCorrelation"]
    got = rosafe.process(given, RATE, parameters=parameters, block_frames=block, outputs=wanted)
    stream = rosafe.Stream(RATE, parameters=parameters, outputs=wanted)
    streamed = [stream.process(part) for part in parts]
    assert overwritten == [True] * 2 * len(parts)
    np.testing.assert_array_equal(given, sound)
    for name in wanted:
        expected = np.concatenate([output[name] for output in outputs], axis=-1)
        np.testing.assert_array_equal(got[name], expected)
        np.testing.assert_array_equal(np.concatenate([part[name] for part in streamed], axis=-1), expected)


@pytest.mark.parametrize("other", ["gammatone", "precedence"])
def test_inputs_with_other_consumers_are_not_overwritten(other: str, overwritten: list[bool]) -> None:
    options: dict[str, Any] = {"parameters": FEW, "outputs": ["ratemap", other]}
    got = rosafe.process(SOUND, RATE, block_frames=1000, **options)
    rosafe.Stream(RATE, **options).process(SOUND)
    assert overwritten == [False] * 4
    names = [name for name in got if name.startswith(other)]
    alone = rosafe.process(SOUND, RATE, block_frames=1000, parameters=FEW, outputs=[other])
    for name in names:
        np.testing.assert_array_equal(got[name], alone[name])


@pytest.mark.parametrize("lengths", [[0], [1] * 64, [9, 8, 9, 31, 32, 33], [0, 700, 0, 1]], ids=str)
def test_concatenate_matches_numpy(lengths: list[int]) -> None:
    rng = np.random.default_rng(len(lengths))
    whole = np.full((3, 7, 1000), np.nan)
    end = 20 + sum(lengths)
    blocks = [rng.standard_normal((3, 7, length)) for length in lengths]
    blocks[-1] = np.asfortranarray(blocks[-1])
    kernels.concatenate(blocks, whole[..., 20:end])
    np.testing.assert_array_equal(whole[..., 20:end], np.concatenate(blocks, axis=-1))
    assert np.isnan(whole[..., :20]).all() and np.isnan(whole[..., end:]).all()
    kernels.concatenate([block.astype(np.float32) for block in blocks], whole[..., 20:end])
    np.testing.assert_array_equal(whole[..., 20:end], np.concatenate(blocks, axis=-1).astype(np.float32))
