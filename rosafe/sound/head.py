"""A spherical model of the head: delay and filter of the sound at each ear.

Woodworth's delays and a head shadow of one pole and one zero for each ear, in the form of C. P. Brown and R. O. Duda
(1998), "A structural model for binaural sound synthesis", IEEE Trans. Speech Audio Process. 6, 476-488.
"""

from __future__ import annotations

import numpy as np

HEAD_RADIUS = 0.0875  # m
SPEED_OF_SOUND = 343.0  # m/s
HEAD_TIME = HEAD_RADIUS / SPEED_OF_SOUND  # s


def ear_delay(incidence: np.ndarray) -> np.ndarray:
    """Return Woodworth's delay (s) to an ear, relative to the head's centre; `incidence` is 0 to pi rad."""
    return HEAD_TIME * np.where(incidence < np.pi / 2, -np.cos(incidence), incidence - np.pi / 2)


def shadow_gain(incidence: np.ndarray) -> np.ndarray:
    """Return the head's gain at high frequencies, from 2 at the ear to 0.1 behind the head (Brown and Duda, eq. 4)."""
    return 1.05 + 0.95 * np.cos(incidence * (180.0 / 150.0))
