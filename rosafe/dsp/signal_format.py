"""What flows from a processor to those that hang on it, beside the samples: rates, frames, channels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SignalFormat:
    """The format of a stage's input or output. Equal formats mean that what comes goes on as before.

    Attributes
    ----------
    sample_rate : float
        Of the sound (Hz).
    rate : float
        Of this signal: samples or frames per second (Hz).
    framed : bool
        Whether it is in frames; frame k covers the samples of sound from k * hop to k * hop + window.
    hop, window : int
        In samples of the sound.
    center_frequencies : tuple of float
        Of the channels (Hz), where there are any.
    filterbank : str
        The type of filterbank that it comes from; empty before it.
    lags : int
        The greatest lag in samples of the sound, where there is a lag axis.
    """

    sample_rate: float
    rate: float
    framed: bool = False
    hop: int = 1
    window: int = 1
    center_frequencies: tuple[float, ...] = ()
    filterbank: str = ""
    lags: int = 0

    @classmethod
    def sound(cls, sample_rate: float) -> SignalFormat:
        """That of samples of sound."""
        return cls(sample_rate, sample_rate)
