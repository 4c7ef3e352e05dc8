"""Recursive filters with state: cascades and banks of first- and second-order sections."""

from __future__ import annotations

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


def normal_form(section: NDArray[np.float64]) -> tuple[float, complex, complex]:
    """Return b0, a pole p and a weight w: y[n] = b0 x[n] + 2 Re(w s[n-1]) with s[n] = p s[n-1] + x[n].

    The section (b0, b1, b2, 1, a1, a2) has a pair of complex poles, or one real pole: then p and w are real, and y[n]
    is b0 x[n] + w s[n-1].
    """
    b0, b1, b2, _, a1, a2 = section.astype(np.longdouble)
    if not a2:
        return float(b0), complex(-a1), complex(b1 - b0 * a1)
    pole = -a1 / 2 + 1j * np.sqrt(a2 - a1 * a1 / 4)
    weight = ((b1 - b0 * a1) * pole + b2 - b0 * a2) / (2j * pole.imag)
    return float(b0), complex(pole), complex(weight)


class NormalFormFilter:
    """A cascade of second-order sections with complex poles, in normal form: one complex pole for each section.

    The state of a pole only turns and shrinks. That of `SosFilter` loses digits if the poles are near 1, as those of a
    high-pass at a few Hz are: four at 1 Hz and 48 kHz.
    """

    def __init__(self, sections: NDArray[np.float64]) -> None:
        forms = [normal_form(section) for section in sections]
        self._steps = [(b0, SosFilter(np.array([[0, weight, 0, 1, -pole, 0]]))) for b0, pole, weight in forms]
        self.sections = sections

    def reset(self) -> None:
        """Reset the state to rest."""
        for _, pole in self._steps:
            pole.reset()

    def process(self, block: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filter (*rows, N) along its last axis."""
        for b0, pole in self._steps:
            block = b0 * block + 2 * pole.process(block).real
        return block


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
