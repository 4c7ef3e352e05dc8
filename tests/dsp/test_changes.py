"""Parameters: the interface table, invalid values, changes between blocks and the states that they reset."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rosafe import interface
from rosafe.dsp.erb import erb_rate
from rosafe.dsp.stage import Stage
from rosafe.dsp.windows import window
from rosafe.representations import STAGES
from rosafe.representations.crosscorrelation import CrossCorrelation
from rosafe.representations.gammatone import Filterbank
from rosafe.representations.haircell import InnerHairCell
from rosafe.representations.ild import Ild
from rosafe.representations.input import Input
from rosafe.representations.preproc import PreProc
from rosafe.representations.ratemap import Ratemap
from rosafe.representations.registry import CORE_KINDS

from .bare import run
from .stages import MODES, NAMES, RATE, make, noise, rows


def test_current_channels() -> None:
    default = Filterbank(44100).parameters
    assert (default["fb_nChannels"], default["fb_nERBs"], default["fb_highFreqHz"]) == (31, 1.0, 8000.0)
    assert default["fb_cfHz"][-1] == pytest.approx(7641.313909)

    number = Filterbank(44100, fb_nChannels=23).parameters
    assert number["fb_nERBs"] == pytest.approx(1.322300741)
    assert (number["fb_cfHz"][0], number["fb_cfHz"][-1], len(number["fb_cfHz"])) == (80.0, 8000.0, 23)
    np.testing.assert_allclose(np.diff(erb_rate(number["fb_cfHz"]), 2), 0, atol=1e-12)

    listed = Filterbank(44100, fb_cfHz=np.array([500, 250, 1000]), fb_nChannels=7).parameters
    assert listed["fb_cfHz"] == [500.0, 250.0, 1000.0]
    assert (listed["fb_lowFreqHz"], listed["fb_highFreqHz"]) == (500.0, 1000.0)
    assert (listed["fb_nERBs"], listed["fb_nChannels"]) == (0.0, 3)
    again = {name: value for name, value in listed.items() if name != "fb_nERBs"}
    assert Filterbank(44100, **again).parameters == listed

    assert Filterbank(44100, fb_nChannels=1).parameters["fb_cfHz"] == [80.0]
    for nothing in ([], (), 0, [0], None, np.array([])):
        assert Filterbank(44100, fb_cfHz=nothing).parameters == default
    assert Filterbank(44100, fb_cfHz=440).parameters["fb_cfHz"] == [440.0]


@pytest.mark.parametrize("low", [50.0, 100.0])  # at 50 Hz, rounding makes the range a little longer
@pytest.mark.parametrize(("steps", "step"), [(100, 0.1), (10, 1.0), (4, 2.5), (1, 10.0), (6, 1.0), (8, 0.3)])
def test_a_range_of_whole_steps_excludes_its_end(low: float, steps: int, step: float) -> None:
    high = 24.7 * 9.265 * math.expm1((erb_rate(low) + steps * step) / 9.265)
    made = Filterbank(44100, fb_lowFreqHz=low, fb_highFreqHz=high, fb_nERBs=step)
    assert made.parameters["fb_nChannels"] == steps


# --- invalid values ---------------------------------------------------------------------------------------------------

NAN, INF = math.nan, math.inf
REFUSED: list[tuple[str, dict[str, Any]]] = [  # tests/interface tries values beyond the declared ranges
    ("input", {"in_normalizeValue": 2**64}),
    ("preProc", {"pp_bRemoveDC": True, "pp_cutoffHzDC": 8000.0}),
    ("preProc", {"pp_middleEarModel": "ear"}),
    ("gammatone", {"fb_lowFreqHz": 5000.0, "fb_highFreqHz": 4000.0}),
    ("gammatone", {"fb_lowFreqHz": 4000.0, "fb_highFreqHz": 4000.0}),
    ("gammatone", {"fb_highFreqHz": 8000.0, "fb_nChannels": 16}),  # the last channel at half the sample rate
    ("gammatone", {"fb_nERBs": 1e-9}),
    *(("gammatone", {"fb_cfHz": value}) for value in ([100, 8000], [100, 0], [NAN], "440", [[1], "x"], [1] * 1025)),
    ("gammatone", {"fb_type": "drnl", "fb_cfHz": [7900.0]}),
    ("gammatone", {"fb_type": "drnl", "fb_cfHz": [1e-300, 100]}),
    *(("ild", {name: value}) for name in ("ild_wSizeSec", "ild_hSizeSec") for value in (1e300, 1e-6)),
    ("ratemap", {"rm_scaling": "_power"}),
    ("crossCorrelation", {"cc_maxDelaySec": 1e300}),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "changes"), REFUSED)
def test_an_invalid_value_changes_nothing(kind: str, changes: dict[str, Any]) -> None:
    names = "|".join(changes) + "|fb_cfHz|fb_highFreqHz"
    with pytest.raises(ValueError, match=f"^({names}): ") as refusal:
        STAGES[kind](RATE, **changes)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 200

    stage, reference_stage = (STAGES[kind](RATE) for _ in range(2))
    for each in (stage, reference_stage):
        each.process(noise(kind, 500))
    other = {p.name: p.default for p in interface.KINDS[kind].parameters if p.name not in changes}
    with pytest.raises(ValueError, match=f"^({names}): "):
        stage.configure(**other, **changes)  # the valid ones first
    assert stage.parameters == reference_stage.parameters
    block = noise(kind, 700, seed=2)
    np.testing.assert_array_equal(stage.process(block), reference_stage.process(block))
    assert stage.output_format.rate == reference_stage.output_format.rate


@pytest.mark.parametrize("kind", CORE_KINDS)
@pytest.mark.parametrize("rate", [0, -1, NAN, INF, "44100", None])
def test_bad_sample_rates(kind: str, rate: Any) -> None:
    with pytest.raises(ValueError, match=r"^sample_rate: "):
        STAGES[kind](rate)


@pytest.mark.parametrize("kind", CORE_KINDS)
def test_unknown_names(kind: str) -> None:
    with pytest.raises(ValueError, match=r"^fb_bAlign: .*no such parameter"):
        STAGES[kind](RATE, fb_bAlign=True)
    with pytest.raises(ValueError, match=r"^name: "):
        STAGES[kind](RATE).configure(name="x")


def test_sample_rates_too_low_for_a_filter() -> None:
    with pytest.raises(ValueError, match=r"^ihc_method: expected a sample rate above 2000 Hz for dau, got "):
        InnerHairCell(2000)
    with pytest.raises(
        ValueError, match=r"^pp_middleEarModel: expected a sample rate above .* Hz for lopezpoveda, got "
    ):
        PreProc(200, pp_bMiddleEarFiltering=True, pp_middleEarModel="lopezpoveda")
    PreProc(30)  # parameters of disabled steps are not checked
    assert PreProc(RATE, pp_middleEarModel="jespen").parameters["pp_middleEarModel"] == "jepsen"


# --- changes and their resets -----------------------------------------------------------------------------------

PREPROC = {"pp_bRemoveDC": True, "pp_bPreEmphasis": True, "pp_bNormalizeRMS": True, "pp_bMiddleEarFiltering": True}


@pytest.mark.parametrize("name", [p.name for p in PreProc.REPRESENTATION.parameters])
def test_any_preproc_parameter_resets_all_its_filters(name: str) -> None:
    stage = PreProc(RATE, **PREPROC)
    stage.process(noise("preProc", 500) + 0.5)
    changed = {**stage.parameters, name: {"pp_middleEarModel": "lopezpoveda", "pp_cutoffHzDC": 50.0}.get(name, 1)}
    stage.configure(**{name: changed[name]})
    block = noise("preProc", 500, seed=2)
    np.testing.assert_array_equal(stage.process(block), PreProc(RATE, **changed).process(block))


def test_input_changes_from_the_next_block() -> None:
    stage = Input(RATE)
    block = noise("input", 10)
    stage.configure(in_normalizeValue=1000)
    np.testing.assert_array_equal(stage.process(block), block / 1000)
    stage.configure(in_doNormalize=False)
    np.testing.assert_array_equal(stage.process(block), block)


@pytest.mark.parametrize(
    "changes", [{"fb_bwERBs": 1.3}, {"fb_nGamma": 2}, {"fb_type": "drnl"}, {"fb_nChannels": 3}, {"fb_bwERBs": 1.018}]
)
def test_any_filterbank_parameter_resets_all_its_filters(changes: dict[str, Any]) -> None:
    base: dict[str, Any] = {"fb_highFreqHz": 4000.0, "fb_nChannels": 4}
    stage = Filterbank(RATE, **base)
    stage.process(noise("gammatone", 500))
    stage.configure(**changes)
    block = noise("gammatone", 500, seed=2)
    np.testing.assert_array_equal(stage.process(block), Filterbank(RATE, **{**base, **changes}).process(block))
    assert stage.output_rows((2,)) == (2, changes.get("fb_nChannels", 4))


def test_which_channel_setting_decides() -> None:
    stage = Filterbank(44100, fb_cfHz=[440.0, 880.0])

    def channels() -> list[float]:
        return [round(f, 6) for f in stage.parameters["fb_cfHz"]]

    stage.configure(fb_bwERBs=1.2)
    assert channels() == [440, 880]
    stage.configure(fb_nChannels=0)
    assert channels() == [440, 880]  # no number of channels: the list is kept
    stage.configure(fb_nChannels=2)
    assert channels() == [80, 8000]
    stage.configure(fb_cfHz=[500.0])
    assert channels() == [500]
    assert stage.parameters["fb_nERBs"] == 0
    stage.configure(fb_cfHz=[])
    assert channels() == [80, 8000]  # as before the list
    stage.configure(fb_lowFreqHz=100)
    assert channels() == [100, 8000]
    stage.configure(fb_nERBs=10.0)
    assert len(channels()) == 3
    assert stage.parameters["fb_nERBs"] == 10
    stage.configure(fb_cfHz=[500.0])
    stage.configure(fb_highFreqHz=1000)
    assert len(channels()) == math.ceil((erb_rate(1000) - erb_rate(100)) / 10)
    stage.configure(fb_cfHz=[300.0], fb_nChannels=9, fb_nERBs=2)
    assert channels() == [300]
    stage.configure(fb_cfHz=0)
    assert len(channels()) == 9
    stage.configure(fb_nERBs=3.0, fb_nChannels=5)
    assert len(channels()) == 5


def test_hair_cell_method_resets_the_filter() -> None:
    stage = InnerHairCell(RATE)
    stage.process(noise("ihc", 500))
    stage.configure(ihc_method="joergensen")
    assert stage.required_extra
    block = noise("ihc", 300, seed=2)
    expected = InnerHairCell(RATE, ihc_method="joergensen").process(block, np.abs(block))
    np.testing.assert_array_equal(stage.process(block, np.abs(block)), expected)


def ild_of(frame: Any, name: str) -> Any:
    energy = np.mean((window(name, frame.shape[-1]) * frame) ** 2, axis=-1)
    return 10 * np.log10((energy[1] + 2.2204e-16) / (energy[0] + 2.2204e-16))


def test_window_and_hop_change_keep_the_buffer_and_the_grid() -> None:
    """The start of the next frame does not change; it has the new window, and later frames follow at the new hop."""
    x = noise("ild", 1000)
    stage = Ild(RATE, ild_wSizeSec=100 / RATE, ild_hSizeSec=40 / RATE)
    before = stage.process(x[..., :330])  # frames at 0, 40 ... 200; the next at 240
    assert before.shape[-1] == 6
    stage.configure(ild_wSizeSec=60 / RATE, ild_wname="blackman", ild_hSizeSec=25 / RATE)
    after = stage.process(x[..., 330:])
    starts = range(240, 1000 - 60 + 1, 25)
    assert after.shape[-1] == len(starts)
    for frame, start in enumerate(starts):
        np.testing.assert_allclose(after[:, frame], ild_of(x[..., start : start + 60], "blackman"), rtol=0, atol=1e-11)
    assert stage.output_format.rate == RATE / 25


def test_a_shorter_window_finds_its_frames_in_the_buffer() -> None:
    x = noise("ild", 500)
    stage = Ild(RATE, ild_wSizeSec=400 / RATE, ild_hSizeSec=50 / RATE)
    assert stage.process(x[..., :390]).shape[-1] == 0
    stage.configure(ild_wSizeSec=100 / RATE)
    assert stage.process(x[..., :0]).shape[-1] == (390 - 100) // 50 + 1


def test_hop_longer_than_window_then_shorter() -> None:
    x = noise("ild", 500)
    stage = Ild(RATE, ild_wSizeSec=20 / RATE, ild_hSizeSec=150 / RATE)
    stage.process(x[..., :30])  # the next frame starts at 150
    stage.configure(ild_hSizeSec=10 / RATE)
    after = stage.process(x[..., 30:])
    np.testing.assert_allclose(after[:, 0], ild_of(x[..., 150:170], "hann"), rtol=0, atol=1e-11)
    assert after.shape[-1] == (350 - 20) // 10 + 1


@pytest.mark.parametrize("change", [{"rm_decaySec": 0.02}, {"rm_scaling": "power"}, {"rm_decaySec": 0.008}])
def test_ratemap_integrator_is_reset_and_the_buffer_is_kept(change: dict[str, Any]) -> None:
    x = np.abs(noise("ratemap", 400))
    stage = Ratemap(RATE, rm_wSizeSec=100 / RATE, rm_hSizeSec=50 / RATE, rm_scaling="magnitude")
    stage.process(x[..., :130])  # one frame; the next at 50
    stage.configure(**change)
    got = stage.process(x[..., 130:])

    def integrated(part: Any, decay: float) -> Any:
        retention = math.exp(-1 / (RATE * decay))
        out, last = np.zeros_like(part), np.zeros(part.shape[:-1])
        for n in range(part.shape[-1]):
            out[..., n] = last = retention * last + (1 - retention) * part[..., n]
        return out

    smooth = np.concatenate(
        [integrated(x[..., :130], 0.008), integrated(x[..., 130:], change.get("rm_decaySec", 0.008))], axis=-1
    )
    frames = np.stack([smooth[..., s : s + 100] for s in range(50, 301, 50)], axis=-2) * window("hann", 100)
    expected = np.mean(frames**2 if "rm_scaling" in change else frames, axis=-1)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=0)


def test_ratemap_window_change_keeps_the_integrator() -> None:
    x = np.abs(noise("ratemap", 400))
    framed = {"rm_wSizeSec": 50 / RATE, "rm_hSizeSec": 50 / RATE}
    whole = Ratemap(RATE, **framed, rm_wname="hamming").process(x)
    stage = Ratemap(RATE, **framed)
    stage.process(x[..., :100])
    stage.configure(rm_wname="hamming")
    np.testing.assert_allclose(stage.process(x[..., 100:]), whole[..., 2:], rtol=1e-13)


def test_lag_and_frame_shapes_are_rebuilt() -> None:
    x = noise("crossCorrelation", 900)
    whole = CrossCorrelation(RATE, cc_maxDelaySec=40 / RATE).process(x)
    stage = CrossCorrelation(RATE, cc_maxDelaySec=5 / RATE)
    assert stage.process(x[..., :500]).shape == (3, 11, 2)
    stage.configure(cc_maxDelaySec=40 / RATE)
    assert stage.output_rows((2, 3)) == (3, 81)
    assert len(np.array(stage.derived["cc_lags"])) == 81
    np.testing.assert_allclose(stage.process(x[..., 500:]), whole[..., 2:], rtol=0, atol=1e-14)


@pytest.mark.parametrize(("kind", "parameters"), MODES, ids=NAMES)
def test_no_change_is_no_reset(kind: str, parameters: dict[str, Any]) -> None:
    stage, reference_stage = STAGES[kind](RATE, **parameters), make(kind, parameters)

    class Configured(Stage):
        """A stage with an empty change before each block."""

        def __init__(self) -> None:
            pass

        def process(self, block: Any, extra: Any = None, out: Any = None) -> Any:
            stage.configure()
            return (
                stage.process(block, np.abs(block) + 0.5) if isinstance(stage, InnerHairCell) else stage.process(block)
            )

    blocks = [noise(kind, 200, seed) for seed in range(3)]
    expected = run(reference_stage, blocks)
    np.testing.assert_array_equal(run(Configured(), blocks), expected[:2] if kind == "gammatone" else expected)
    assert len(rows(kind)) + 1 == blocks[0].ndim
