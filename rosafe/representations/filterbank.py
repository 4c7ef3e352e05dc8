"""The filterbank stage: which channels there are, and gammatone or DRNL filters for them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from rosafe.declarations.parameter import MAX_SEQUENCE, Parameter
from rosafe.declarations.representation import Representation
from rosafe.dsp.drnl import DrnlBank
from rosafe.dsp.erb import erb_rate, erb_rate_to_frequency
from rosafe.dsp.gammatone import GammatoneBank
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

MAX_CHANNELS = MAX_SEQUENCE
MAX_RELATIVE_FREQUENCY = 0.475  # of the sample rate, for channels: speech at 16 kHz has them up to 7600 Hz


class Filterbank(Stage):
    """Frequency channels of the ear signals, (2, N) to (2, C, N). Any change of a parameter starts all filters anew.

    Channels come from the list `fb_cfHz`; without one, `fb_nChannels` of them lie evenly on the ERB-rate scale from
    `fb_lowFreqHz` to `fb_highFreqHz`; where that is 0, every `fb_nERBs` from the lowest on and strictly below the
    highest. A change goes the same way: what was set last decides (numbers of ERBs drop number and list, number and
    range drop the list, an empty list brings the others back).

    `parameters` tells the channels in force: with a list, `fb_nERBs` is 0 and the range its first and last element;
    with a number of channels n, `fb_nERBs` is the width of the range divided by n, as in the original.

    Where `fb_highFreqHz` has never been given and a channel at its default would lie at or above half of the sample
    rate, 0.475 of that rate is in its place.

    The envelope of the output, (2, C, N), is provided to those who need it: 2 abs(H x) for gammatone; for DRNL see
    `DrnlBank`. It costs time.
    """

    REPRESENTATION = Representation(
        kind="gammatone",
        doc="Split the signal into frequency channels",
        parent="preProc",
        axes=("ear", "channel", "time"),
        parameters=(
            Parameter(
                "fb_type",
                "string",
                "gammatone",
                "Filterbank type (gammatone or drnl)",
                choices=("gammatone", "drnl"),
                fallback="gammatone",
            ),
            Parameter(
                "fb_lowFreqHz", "double", 80.0, "Lowest center frequency (Hz)", 0.0, 1e6, open_minimum=True, unit="Hz"
            ),
            Parameter(
                "fb_highFreqHz",
                "double",
                8000.0,
                "Highest center frequency (Hz); not given: 0.475 of the sample rate if channels reach half of that",
                0.0,
                1e6,
                open_minimum=True,
                unit="Hz",
                follows_rate=True,
            ),
            Parameter(
                "fb_nERBs",
                "double",
                1.0,
                "Distance between neighboring filters in ERBs",
                0.0,
                100.0,
                open_minimum=True,
                unit="ERB",
            ),
            Parameter(
                "fb_nChannels",
                "unsigned long",
                0,
                "Number of channels; 0: as many as fb_nERBs gives",
                0,
                MAX_CHANNELS,
            ),
            Parameter(
                "fb_cfHz",
                "sequence<double>",
                (),
                "Channels center frequencies (Hz); empty: chosen from the other parameters",
                0.0,
                1e6,
                open_minimum=True,
                unit="Hz",
            ),
            Parameter("fb_nGamma", "unsigned long", 4, "Gammatone rising slope order", 1, 128),
            Parameter(
                "fb_bwERBs",
                "double",
                1.018,
                "Bandwidth of the filters in ERBs",
                0.0,
                10_000.0,
                open_minimum=True,
                unit="ERB",
            ),
        ),
        coordinates=("fb_cfHz",),
        name_doc="The name of this activity",
        request_aliases=("Gammatone",),
        port_doc="What each filterbank put out",
        word="filterbank",
    )
    INPUT = ("ear", "time")
    EXTRAS = ("envelope",)
    CHANNEL_INDEPENDENT = True

    _given: frozenset[str] = frozenset()  # of what follows the rate

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        frequencies = center_frequencies(values).tolist()
        told = {**values, "fb_nChannels": len(frequencies), "fb_cfHz": frequencies}
        if values["fb_cfHz"]:
            told.update(fb_lowFreqHz=frequencies[0], fb_highFreqHz=frequencies[-1], fb_nERBs=0.0)
        elif values["fb_nChannels"]:
            told["fb_nERBs"] = float(erb_rate(frequencies[-1]) - erb_rate(frequencies[0])) / len(frequencies)
        return told

    @classmethod
    def resolve_rate_defaults(
        cls, values: Mapping[str, Any], given: Collection[str], sample_rate: float
    ) -> dict[str, Any]:
        free = "fb_highFreqHz" not in given and not values["fb_cfHz"]
        if free and center_frequencies(values).max() >= sample_rate / 2:
            return {**values, "fb_highFreqHz": MAX_RELATIVE_FREQUENCY * sample_rate}
        return dict(values)

    @classmethod
    def request_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        listed = bool(values.get("fb_cfHz")) and values.get("fb_nERBs") == 0
        return {name: value for name, value in values.items() if not (listed and name == "fb_nERBs")}

    @property
    def parameters(self) -> dict[str, Any]:
        return self.effective_values(self.resolve_rate_defaults(self.values, self._given, self.sample_rate))

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (*rows, len(self._frequencies))

    def process(self, block: FloatArray, extra: FloatArray | None = None, out: FloatArray | None = None) -> FloatArray:
        samples = self._as_valid_block(block)
        place = self._output_array((2, len(self._frequencies), samples.shape[-1]), out)
        output, envelope = self._bank.process(samples, "envelope" in self.provide, place)
        self.provided = {} if envelope is None else {"envelope": envelope}
        return output

    def reset(self) -> None:
        self._bank.reset()
        self.provided = {}

    @cached_property
    def output_format(self) -> SignalFormat:
        channels = tuple(self._frequencies.tolist())
        return replace(self.input_format, center_frequencies=channels, filterbank=self.values["fb_type"])

    def _resolve_values(self, checked: dict[str, Any]) -> dict[str, Any]:
        values = super()._resolve_values(checked)
        self._given = self._given | ({"fb_highFreqHz"} & checked.keys())
        decides = checked.get("fb_nChannels") or {"fb_lowFreqHz", "fb_highFreqHz", "fb_nERBs"} & checked.keys()
        if decides and not checked.get("fb_cfHz"):
            values["fb_cfHz"] = []
        if "fb_nERBs" in checked and not checked.get("fb_nChannels"):
            values["fb_nChannels"] = 0
        return values

    def build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        values = self.resolve_rate_defaults(values, self._given, self.sample_rate)
        frequencies = center_frequencies(values)
        if frequencies.max() >= self.sample_rate / 2:
            raise ValueError(
                f"{_chosen_by(values)}: a channel at {frequencies.max():.12g} Hz is not below half the sample rate; "
                f"{MAX_RELATIVE_FREQUENCY * self.sample_rate:.12g} Hz would do"
            )
        bank: GammatoneBank | DrnlBank
        if values["fb_type"] == "drnl":
            bank = DrnlBank(self.sample_rate, frequencies)
        else:
            bank = GammatoneBank(self.sample_rate, frequencies, values["fb_nGamma"], values["fb_bwERBs"])
        self._bank, self._frequencies, self.provided = bank, frequencies, {}


def _chosen_by(values: Mapping[str, Any]) -> str:
    return "fb_cfHz" if values["fb_cfHz"] else "fb_highFreqHz"


def center_frequencies(values: Mapping[str, Any]) -> FloatArray:
    """Centre frequencies (C,) in Hz that the checked parameters of `Filterbank` ask for; ValueError if impossible."""
    if values["fb_cfHz"]:
        return np.array(values["fb_cfHz"])
    low, high, count, step = (values[f"fb_{name}"] for name in ("lowFreqHz", "highFreqHz", "nChannels", "nERBs"))
    if low > high or (low == high and count != 1):
        raise ValueError(f"fb_lowFreqHz: {low:.12g} Hz is not below fb_highFreqHz ({high:.12g} Hz)")
    low_rate, high_rate = float(erb_rate(low)), float(erb_rate(high))
    if count:
        frequencies = erb_rate_to_frequency(np.linspace(low_rate, high_rate, count))
        frequencies[-1] = high
    else:
        frequencies = erb_rate_to_frequency(low_rate + step * np.arange(_steps_below(high_rate - low_rate, step)))
    frequencies[0] = low  # the ends are what was asked for, not that after rounding there and back
    return frequencies


def _steps_below(span: float, step: float) -> int:
    """How many of 0, step, 2 step... lie strictly below `span`, whatever rounding does to a span of whole steps."""
    if span / step > MAX_CHANNELS:
        raise ValueError(f"fb_nERBs: {step:.12g} gives too many channels, at most {MAX_CHANNELS}")
    return max(1, math.ceil(span / step - 1e-9))
