"""Middle ear filters from published measurements: sound pressure at the eardrum to velocity of the stapes.

Data: R. L. Goode, M. Killion, K. Nakamura and S. Nishihara (1994), "New knowledge about the function of the human
middle ear", Am. J. Otol. 15; E. A. Lopez-Poveda and R. Meddis (2001), "A human nonlinear cochlear filterbank",
J. Acoust. Soc. Am. 110; M. L. Jepsen, S. D. Ewert and T. Dau (2008), "A computational model of human auditory signal
processing and perception", J. Acoust. Soc. Am. 124. Designs as in the MATLAB functions of the auditory front-end.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import scipy

from .numeric_limits import FloatArray, modulus

ORDER = 512
MODELS = ("jepsen", "lopezpoveda")

# Nominal peaks of the two filters, inverted by pp_bUnityComp. The actual peaks, which depend on the sample rate, differ
# by up to 0.5 dB.
PEAK_DB = {"jepsen": 55.9986, "lopezpoveda": 66.2888}

REFERENCE_DB_SPL = 104.0  # level at which the displacement was measured
REFERENCE_PRESSURE = 20e-6  # Pa

_TABLES = json.loads(Path(__file__).with_name("middle_ear.json").read_text("utf-8"))
# Goode et al. (1994): Hz, peak-to-peak displacement of the stapes in µm at 104 dB SPL
STAPES_DISPLACEMENT = np.array(_TABLES["stapes_displacement"])

# Lopez-Poveda and Meddis (2001): Hz, peak velocity of the stapes in m/s at 0 dB SPL, extrapolated at both ends
STAPES_VELOCITY_EXTRAPOLATED = np.array(_TABLES["stapes_velocity_extrapolated"])

# Jepsen et al. (2008): Hz, impedance of the stapes
STAPES_IMPEDANCE = np.array(_TABLES["stapes_impedance"])


def middle_ear_fir(model: str, sample_rate: float, unity: bool) -> FloatArray:
    """Return the impulse response (513,) of the middle ear.

    Parameters
    ----------
    model : {"jepsen", "lopezpoveda"}
        Linear phase (256 samples of delay) or minimum phase.
    sample_rate : float
        In Hz.
    unity : bool
        Scale the peak to a nominal 0 dB; otherwise the output for an input of RMS 1 at 100 dB SPL is in m/s.

    Raises
    ------
    ValueError
        If the sample rate is so low that no measured point is below half of it.
    """
    nyquist = sample_rate / 2
    lowest = {"jepsen": STAPES_IMPEDANCE[0, 0], "lopezpoveda": STAPES_VELOCITY_EXTRAPOLATED[0, 0]}[model]
    if nyquist <= lowest:
        raise ValueError(
            f"pp_middleEarModel: expected a sample rate above {2 * lowest:.12g} Hz for {model}, got "
            f"{sample_rate:.12g} Hz"
        )
    fir = _jepsen(nyquist) if model == "jepsen" else _lopezpoveda(nyquist)
    return fir * 10 ** (PEAK_DB[model] / 20) if unity else fir


def _frequency_sampling(frequencies: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """Design an FIR filter as ``fir2`` of MATLAB, but do not move breakpoints to the grid (an error of 2 dB at 100 Hz).

    `scipy.signal.firwin2` does not accept such a small number of grid points.
    """
    grid = np.linspace(0.0, frequencies[-1], ORDER + 1)
    delay = np.exp(-1j * np.pi * (ORDER / 2) * np.arange(ORDER + 1) / ORDER)
    response = np.interp(grid, frequencies, amplitudes) * delay
    fir: FloatArray = scipy.fft.irfft(response, 2 * ORDER)[: ORDER + 1] * scipy.signal.windows.hamming(ORDER + 1)
    return fir


def _jepsen(nyquist: float) -> FloatArray:
    frequencies, impedances = STAPES_IMPEDANCE[STAPES_IMPEDANCE[:, 0] < nyquist].T
    fir = _frequency_sampling(np.r_[0.0, frequencies, nyquist], np.r_[0.0, 1 / impedances, 0.0])
    fir /= modulus(scipy.fft.fft(fir)).max()
    return fir * 1e-8 * 10 ** (REFERENCE_DB_SPL / 20)


def _lopezpoveda(nyquist: float) -> FloatArray:
    frequencies, displacements = STAPES_DISPLACEMENT.T
    # from µm peak-to-peak at the reference level to m/s; the factor sqrt(2) is in the published MATLAB design
    velocities = displacements * 1e-6 * 2 * np.pi * frequencies * 10 ** (-REFERENCE_DB_SPL / 20) * np.sqrt(2)
    table = np.vstack([STAPES_VELOCITY_EXTRAPOLATED, np.column_stack([frequencies, velocities])])
    table = table[np.argsort(table[:, 0])]
    table = table[table[:, 0] < nyquist] if nyquist <= table[-1, 0] else table

    points = [tuple(point) for point in table]
    while nyquist > table[-1, 0] and points[-1][0] + 1000 <= nyquist:
        points.append((points[-1][0] + 1000, points[-1][1] / 1.1))
    last_frequency, last_velocity = points[-1]
    if last_frequency != nyquist:
        points.append((nyquist, last_velocity / (1 + (nyquist - last_frequency) * 0.1 / 1000)))

    frequencies, velocities = np.array([(0.0, 0.0), *points]).T
    return _minimum_phase(_frequency_sampling(frequencies, velocities) / REFERENCE_PRESSURE)


def _minimum_phase(fir: FloatArray) -> FloatArray:
    """Return the minimum phase response with the magnitude of `fir` on a grid of the same length."""
    magnitude = np.maximum(modulus(scipy.fft.fft(fir)), np.finfo(np.float64).tiny)
    phase = -np.imag(scipy.signal.hilbert(np.log(magnitude)))
    response: FloatArray = scipy.fft.ifft(magnitude * np.exp(1j * phase)).real
    return response
