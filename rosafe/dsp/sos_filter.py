"""Recursive filters with state: cascades and banks of first- and second-order sections."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from rosafe.dsp.numeric_limits import FLUSH_INTERVAL, flush_denormals


class SosFilter:
    """A cascade of second-order sections with its state, initially at rest.

    Parameters
    ----------
    sections : ndarray (S, 6)
        Real or complex sections as in `scipy.signal.sosfilt`: b0, b1, b2, 1, a1, a2.
    """

    def __init__(self, sections: NDArray[Any]) -> None:
        self.sections = np.ascontiguousarray(sections)
        self.state: NDArray[Any] | None = None  # (S, *rows, 2), direct form II transposed; None at rest
        self._position = 0

    def reset(self) -> None:
        """Reset the state to rest."""
        self.state = None

    def ensure_state(self, rows: tuple[int, ...]) -> NDArray[Any]:
        """Return the state for a block of leading shape `rows`. A change of that shape resets it."""
        shape = (len(self.sections), *rows, 2)
        if self.state is None or self.state.shape != shape:
            self.state = np.zeros(shape, self.sections.dtype)
            self._position = 0
        return self.state

    def process(self, block: NDArray[Any]) -> NDArray[Any]:
        """Filter (*rows, N) along its last axis. Return `block` itself if there are no sections."""
        state = self.ensure_state(block.shape[:-1])
        if len(self.sections) == 0:
            return block
        if block.size == 0:
            return np.zeros(block.shape, state.dtype)
        result = np.empty(block.shape, state.dtype)
        for span, whole in _spans(self._position, block.shape[-1]):
            result[..., span], state = scipy.signal.sosfilt(self.sections, block[..., span], zi=state)
            if whole:
                state = np.ascontiguousarray(state)
                flush_denormals(state)
        self.state = np.ascontiguousarray(state)
        self._position += block.shape[-1]
        return result


class HighPass:
    """A Butterworth high-pass of even order, in normal form: one complex pole for each section.

    y[n] = g x[n] + 2 Re(w s[n-1]) with s[n] = p s[n-1] + x[n], for each pair of poles p. The state of a pole only turns
    and shrinks. That of `SosFilter` loses digits for cutoffs far below the sample rate: four at 1 Hz and 48 kHz.

    Parameters
    ----------
    order : int
        Even.
    cutoff, sample_rate : float
        In Hz. The bilinear transform is prewarped.

    Attributes
    ----------
    forms : list of (float, complex, complex)
        g, p and w of each section.
    """

    def __init__(self, order: int, cutoff: float, sample_rate: float) -> None:
        self.forms = [_high_pass_form(order, pair, cutoff / sample_rate) for pair in range(order // 2)]
        self._poles = [SosFilter(np.array([[0, weight, 0, 1, -pole, 0]])) for _, pole, weight in self.forms]

    def reset(self) -> None:
        """Reset the state to rest."""
        for pole in self._poles:
            pole.reset()

    def process(self, block: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filter (*rows, N) along its last axis."""
        for (gain, *_), pole in zip(self.forms, self._poles, strict=True):
            block = gain * block + 2 * pole.process(block).real
        return block


def _high_pass_form(order: int, pair: int, cutoff: float) -> tuple[float, complex, complex]:
    """Return g, p and w of a section; `cutoff` is relative to the sample rate.

    With the pole s of the analog filter, p = (1 + s) / (1 - s), and d = 1 - p is known without cancellation. The
    section is g (1 - 1/z)**2 / ((1 - p/z) (1 - p*/z)), so that w = g j d**2 / (2 Im d).
    """
    analog = math.tan(math.pi * cutoff) * cmath.exp(1j * math.pi * (order + 1 + 2 * pair) / (2 * order))
    distance = -2 * analog / (1 - analog)
    gain = abs(1 / (1 - analog)) ** 2
    weight = 0.5j * gain * distance * (distance / distance.imag) if distance.imag else 0j  # 0: it has underflowed
    return gain, 1 - distance, weight


class SosFilterBank(SosFilter):
    """M real second-order sections in parallel, all of which filter the same samples."""

    def process(self, block: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filter (*rows, N) along its last axis by each section: (*rows, M, N)."""
        states = self.ensure_state(block.shape[:-1])
        result = np.empty((*block.shape[:-1], len(self.sections), block.shape[-1]))
        for number, section in enumerate(self.sections):
            for span, whole in _spans(self._position, block.shape[-1]):
                state = states[number][np.newaxis]
                result[..., number, span], state = scipy.signal.sosfilt([section], block[..., span], zi=state)
                states[number] = state[0]
                if whole:
                    flush_denormals(states[number])
        self._position += block.shape[-1]
        return result


def _spans(position: int, count: int) -> Iterator[tuple[slice, bool]]:
    """Split the `count` samples from `position` on at multiples of `FLUSH_INTERVAL`; yield whether each ends at one.

    Denormal states are flushed only there, so that the result does not depend on block boundaries.
    """
    first = 0
    while first < count:
        end = min(count, first + FLUSH_INTERVAL - (position + first) % FLUSH_INTERVAL)
        yield slice(first, end), (position + end) % FLUSH_INTERVAL == 0
        first = end


def leaky_integrator(decay_factor: float) -> NDArray[np.float64]:
    """Return the section of u[n] = r u[n-1] + (1-r) x[n]; its first state value is r u[n]."""
    return np.array([[1.0 - decay_factor, 0.0, 0.0, 1.0, -decay_factor, 0.0]])
