"""The filterbank stage: the centre frequencies of the channels, and gammatone or DRNL filters for them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from rosafe.declarations.parameter import MAX_SEQUENCE, Parameter
from rosafe.declarations.reference import cite
from rosafe.declarations.representation import Representation
from rosafe.dsp import kernels
from rosafe.dsp.drnl import DrnlBank
from rosafe.dsp.erb import erb_rate, erb_rate_to_frequency
from rosafe.dsp.gammatone import GammatoneBank
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.dsp.signal_format import SignalFormat
from rosafe.dsp.stage import Stage

MAX_CHANNELS = MAX_SEQUENCE
MAX_RELATIVE_FREQUENCY = 0.475  # of the sample rate: channels up to 7600 Hz at 16 kHz


class Filterbank(Stage):
    """Frequency channels of the ear signals, (2, N) to (2, C, N). Any change of a parameter resets all filters.

    Centre frequencies are given by the list `fb_cfHz`. If it is empty, `fb_nChannels` of them are spaced evenly on the
    ERB-rate scale from `fb_lowFreqHz` to `fb_highFreqHz`. If that number is 0, there is one every `fb_nERBs` from the
    lowest frequency on, strictly below the highest. In an update, the parameter set last decides: `fb_nERBs` clears
    number and list, number and range clear the list, and an empty list restores the effect of the others.

    `parameters` reports the current channels: with a list, `fb_nERBs` is 0 and the range is its first and last element;
    with a number of channels n, `fb_nERBs` is the width of the range divided by n, as in the original.

    If `fb_highFreqHz` has never been given and a channel at its default would be at or above half of the sample rate,
    0.475 of that rate is used instead.

    The envelope of the output, (2, C, N), is computed if a child requires it: 2 abs(H x) for gammatone; for DRNL see
    `DrnlBank`. It takes additional time.
    """

    REPRESENTATION = Representation(
        kind="gammatone",
        doc="Split the signal into frequency channels",
        parent="preProc",
        axes=("ear", "channel", "time"),
        level=20.0,
        channel_parameter="fb_cfHz",
        parameters=(
            Parameter.text(
                "fb_type",
                "gammatone",
                "Filterbank type (gammatone or drnl)",
                ("gammatone", "drnl"),
                fallback="gammatone",
            ),
            Parameter.positive("fb_lowFreqHz", 80.0, "Lowest center frequency (Hz)", 1e6, unit="Hz"),
            Parameter.positive(
                "fb_highFreqHz",
                8000.0,
                "Highest center frequency (Hz); not given: 0.475 of the sample rate if channels reach half of that",
                1e6,
                unit="Hz",
                follows_rate=True,
            ),
            Parameter.positive("fb_nERBs", 1.0, "Distance between neighboring filters in ERBs", 100.0, unit="ERB"),
            Parameter.count("fb_nChannels", 0, "Number of channels; 0: as many as fb_nERBs gives", 0, MAX_CHANNELS),
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
            Parameter.count("fb_nGamma", 4, "Gammatone rising slope order", 1, kernels.MAX_POLES),
            Parameter.positive("fb_bwERBs", 1.018, "Bandwidth of the filters in ERBs", 10_000.0, unit="ERB"),
        ),
        coordinates=("fb_cfHz",),
        name_doc="The name of this activity",
        request_aliases=("Gammatone",),
        port_doc="Output of each filterbank",
        word="filterbank",
        references=(
            cite("glasberg1990", "spacing of the channels and bandwidth"),
            cite("patterson1987", "gammatone filters", fb_type="gammatone"),
            cite("hohmann2002", "implementation as a cascade of complex one-pole filters", fb_type="gammatone"),
            cite("lopezpoveda2001", "DRNL filters", fb_type="drnl"),
            cite("jepsen2008", "parameters of the DRNL filters", fb_type="drnl"),
        ),
    )
    INPUT = ("ear", "time")
    EXTRAS = ("envelope",)
    CHANNEL_INDEPENDENT = True

    _given: frozenset[str] = frozenset()  # parameters with a default that follows the sample rate

    @classmethod
    def effective_values(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        frequencies = center_frequencies(values).tolist()
        reported = {**values, "fb_nChannels": len(frequencies), "fb_cfHz": frequencies}
        if values["fb_cfHz"]:
            reported.update(fb_lowFreqHz=frequencies[0], fb_highFreqHz=frequencies[-1], fb_nERBs=0.0)
        elif values["fb_nChannels"]:
            reported["fb_nERBs"] = float(erb_rate(frequencies[-1]) - erb_rate(frequencies[0])) / len(frequencies)
        return reported

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
        output = self._output_array((len(samples), len(self._frequencies), samples.shape[-1]), out)
        envelope = self._bank.process(samples, "envelope" in self.provide, output)
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
            name = "fb_cfHz" if values["fb_cfHz"] else "fb_highFreqHz"
            raise ValueError(
                f"{name}: expected channels below half the sample rate, got one at {frequencies.max():.12g} Hz; "
                f"use at most {MAX_RELATIVE_FREQUENCY * self.sample_rate:.12g} Hz"
            )
        bank: GammatoneBank | DrnlBank
        if values["fb_type"] == "drnl":
            bank = DrnlBank(self.sample_rate, frequencies)
        else:
            bank = GammatoneBank(self.sample_rate, frequencies, values["fb_nGamma"], values["fb_bwERBs"])
        self._bank, self._frequencies, self.provided = bank, frequencies, {}


def center_frequencies(values: Mapping[str, Any]) -> FloatArray:
    """Return the centre frequencies (C,) in Hz for checked parameters of `Filterbank`, or raise ValueError."""
    if values["fb_cfHz"]:
        return np.array(values["fb_cfHz"])
    low, high, count, step = (values[f"fb_{name}"] for name in ("lowFreqHz", "highFreqHz", "nChannels", "nERBs"))
    if low > high or (low == high and count != 1):
        raise ValueError(f"fb_lowFreqHz: expected less than fb_highFreqHz ({high:.12g} Hz), got {low:.12g} Hz")
    low_rate, high_rate = float(erb_rate(low)), float(erb_rate(high))
    if count:
        frequencies = erb_rate_to_frequency(np.linspace(low_rate, high_rate, count))
        frequencies[-1] = high
    else:
        frequencies = erb_rate_to_frequency(low_rate + step * np.arange(_steps_below(high_rate - low_rate, step)))
    frequencies[0] = low  # the exact value of the parameter, not its conversion to ERBs and back
    return frequencies


def _steps_below(span: float, step: float) -> int:
    """Return how many of 0, step, 2 step... are strictly below `span`, allowing for rounding errors."""
    if span / step > MAX_CHANNELS:
        raise ValueError(f"fb_nERBs: expected a distance that gives at most {MAX_CHANNELS} channels, got {step:.12g}")
    return max(1, math.ceil(span / step - 1e-9))
