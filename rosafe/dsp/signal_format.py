"""The format of the signal between a processor and its children: rates, frames, channels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SignalFormat:
    """The format of a stage's input or output. If a format equals the previous one, the signal continues unchanged.

    Attributes
    ----------
    sample_rate : float
        Sample rate of the sound (Hz).
    rate : float
        Samples or frames of this signal per second (Hz).
    framed : bool
        Whether it is in frames; frame k covers the samples of sound from k * hop to k * hop + window.
    hop, window : int
        Samples of the sound.
    center_frequencies : tuple of float
        Centre frequencies of the channels (Hz); empty if there are none.
    filterbank : str
        The type of the filterbank; empty for signals before it.
    lags : int
        The largest lag in samples of the sound, if there is a lag axis.
    ears : int
        The length of axes of ears: 1 for a signal of one ear, which only `rosafe.process` and `Stream` compute.
    """

    sample_rate: float
    rate: float
    framed: bool = False
    hop: int = 1
    window: int = 1
    center_frequencies: tuple[float, ...] = ()
    filterbank: str = ""
    lags: int = 0
    ears: int = 2

    @classmethod
    def sound(cls, sample_rate: float, ears: int = 2) -> SignalFormat:
        """Return the format of samples of sound."""
        return cls(sample_rate, sample_rate, ears=ears)
