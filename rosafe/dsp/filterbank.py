"""The filterbank stage: which channels there are, and gammatone or DRNL filters for them."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from .checks import not_negative, number, positive, whole, word
from .drnl import DrnlBank
from .erb import erb_rate, erb_rate_to_frequency
from .gammatone import GammatoneBank
from .guard import FloatArray
from .stage import Parameter, ParameterTable, Stage

MAX_CHANNELS = 1024


def _frequency_list(name: str, value: Any) -> tuple[float, ...]:
    """Frequencies above 0; None, 0, [0] and [] all mean that there is no list."""
    if isinstance(value, (str, bytes)):
        raise ValueError(f"{name}: {value[:80]!r} is not a list of numbers")
    items = [] if value is None else np.asarray(value, dtype=object).ravel().tolist()
    if len(items) > MAX_CHANNELS:
        raise ValueError(f"{name}: {len(items)} channels are too many, at most {MAX_CHANNELS}")
    if len(items) == 1 and number(name, items[0]) == 0:
        return ()
    return tuple(positive(name, item) for item in items)


class Filterbank(Stage):
    """Frequency channels of the ear signals, (2, N) to (2, C, N). Any change of a parameter starts all filters anew.

    Channels come from the list `fb_cfHz`; without one, `fb_nChannels` of them lie evenly on the ERB-rate scale from
    `fb_lowFreqHz` to `fb_highFreqHz`; where that is 0, every `fb_nERBs` from the lowest on and strictly below the
    highest. A change goes the same way: what was set last decides (numbers of ERBs drop number and list, number and
    range drop the list, an empty list brings the others back).

    `parameters` tells the channels in force: with a list, `fb_nERBs` is 0 and the range its first and last element;
    with a number of channels n, `fb_nERBs` is the width of the range divided by n, as in the original.

    Attributes
    ----------
    provide_envelope : bool
        Whether `process` also puts the envelope of its output into `envelope`; it costs time.
    envelope : ndarray (2, C, N) or None
        Of the last block: 2 abs(H x) for gammatone; for DRNL see `DrnlBank`.
    """

    PARAMETERS: ClassVar[ParameterTable] = {
        "fb_type": Parameter("gammatone", word("gammatone", "drnl")),
        "fb_lowFreqHz": Parameter(80.0, positive),
        "fb_highFreqHz": Parameter(8000.0, positive),
        "fb_nERBs": Parameter(1.0, not_negative),
        "fb_nChannels": Parameter(0, whole(0, MAX_CHANNELS)),
        "fb_cfHz": Parameter((), _frequency_list),
        "fb_nGamma": Parameter(4, whole(1, 128)),
        "fb_bwERBs": Parameter(1.018, positive),
    }
    BLOCK = ("2 ears", "samples")

    def __init__(self, sample_rate: float, **parameters: Any) -> None:
        self.provide_envelope = False
        self.envelope: FloatArray | None = None
        super().__init__(sample_rate, **parameters)

    @property
    def parameters(self) -> dict[str, Any]:
        return {**self._values, **self._in_force, "fb_cfHz": self._frequencies.tolist()}

    def output_rows(self, rows: tuple[int, ...]) -> tuple[int, ...]:
        return (*rows, len(self._frequencies))

    def process(self, block: FloatArray) -> FloatArray:
        output, self.envelope = self._bank.process(self._checked(block), self.provide_envelope)
        return output

    def reset(self) -> None:
        self._bank.reset()
        self.envelope = None

    def _merge(self, checked: dict[str, Any]) -> dict[str, Any]:
        values = super()._merge(checked)
        decides = checked.get("fb_nChannels") or {"fb_lowFreqHz", "fb_highFreqHz", "fb_nERBs"} & checked.keys()
        if decides and not checked.get("fb_cfHz"):
            values["fb_cfHz"] = ()
        if "fb_nERBs" in checked and not checked.get("fb_nChannels"):
            values["fb_nChannels"] = 0
        return values

    def _build(self, values: dict[str, Any], changed: frozenset[str]) -> None:
        frequencies = center_frequencies(values)
        if frequencies.max() >= self.sample_rate / 2:
            raise ValueError(
                f"{_chosen_by(values)}: a channel at {frequencies.max():.12g} Hz is not below half the sample rate"
            )
        bank: GammatoneBank | DrnlBank
        if values["fb_type"] == "drnl":
            bank = DrnlBank(self.sample_rate, frequencies)
        else:
            bank = GammatoneBank(self.sample_rate, frequencies, values["fb_nGamma"], values["fb_bwERBs"])
        in_force: dict[str, Any] = {"fb_nChannels": len(frequencies)}
        if values["fb_cfHz"]:
            in_force.update(fb_lowFreqHz=float(frequencies[0]), fb_highFreqHz=float(frequencies[-1]), fb_nERBs=0.0)
        elif values["fb_nChannels"]:
            span = erb_rate(frequencies[-1]) - erb_rate(frequencies[0])
            in_force["fb_nERBs"] = float(span) / len(frequencies)
        self._bank, self._frequencies, self._in_force, self.envelope = bank, frequencies, in_force, None


def _chosen_by(values: dict[str, Any]) -> str:
    return "fb_cfHz" if values["fb_cfHz"] else "fb_highFreqHz"


def center_frequencies(values: dict[str, Any]) -> FloatArray:
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
    if step == 0 or span / step > MAX_CHANNELS:
        raise ValueError(f"fb_nERBs: {step:.12g} gives too many channels, at most {MAX_CHANNELS}")
    return max(1, math.ceil(span / step - 1e-9))
