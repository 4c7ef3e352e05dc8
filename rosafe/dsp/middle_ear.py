"""Middle ear filters from published measurements: sound pressure at the eardrum to velocity of the stapes.

Data: R. L. Goode, M. Killion, K. Nakamura and S. Nishihara (1994), "New knowledge about the function of the human
middle ear", Am. J. Otol. 15; E. A. Lopez-Poveda and R. Meddis (2001), "A human nonlinear cochlear filterbank",
J. Acoust. Soc. Am. 110; M. L. Jepsen, S. D. Ewert and T. Dau (2008), "A computational model of human auditory signal
processing and perception", J. Acoust. Soc. Am. 124. Designs as in the MATLAB functions of the auditory front-end.
"""

from __future__ import annotations

import numpy as np
import scipy

from .numeric_limits import FloatArray

ORDER = 512
MODELS = ("jepsen", "lopezpoveda")

# Nominal peaks of the two filters, inverted by pp_bUnityComp. The actual peaks, which depend on the sample rate, differ
# by up to 0.5 dB.
PEAK_DB = {"jepsen": 55.9986, "lopezpoveda": 66.2888}

REFERENCE_DB_SPL = 104.0  # level at which the displacement was measured
REFERENCE_PRESSURE = 20e-6  # Pa

# Goode et al. (1994): Hz, peak-to-peak displacement of the stapes in µm at 104 dB SPL
STAPES_DISPLACEMENT = np.array(
    [
        (400, 0.19953),
        (600, 0.22909),
        (800, 0.21878),
        (1000, 0.15136),
        (1200, 0.1),
        (1400, 0.07943),
        (1600, 0.05754),
        (1800, 0.04365),
        (2000, 0.03311),
        (2200, 0.02754),
        (2400, 0.02188),
        (2600, 0.0182),
        (2800, 0.01445),
        (3000, 0.01259),
        (3500, 0.009),
        (4000, 0.007),
        (4500, 0.00457),
        (5000, 0.005),
        (5500, 0.004),
        (6000, 0.003),
        (6500, 0.00275),
    ]
)

# Lopez-Poveda and Meddis (2001): Hz, peak velocity of the stapes in m/s at 0 dB SPL, extrapolated at both ends
STAPES_VELOCITY_EXTRAPOLATED = np.array(
    [
        (100, 1.181e-09),
        (200, 2.363e-09),
        (7000, 8.705e-10),
        (7500, 8e-10),
        (8000, 7.577e-10),
        (8500, 7.168e-10),
        (9000, 6.781e-10),
        (9500, 6.24e-10),
        (10000, 6e-10),
    ]
)

# Jepsen et al. (2008): Hz, impedance of the stapes
STAPES_IMPEDANCE = np.array(
    [
        (50, 48046.39731),
        (100, 24023.19865),
        (200, 12011.59933),
        (400, 6005.799663),
        (600, 3720.406871),
        (800, 2866.404385),
        (1000, 3363.247811),
        (1200, 4379.228921),
        (1400, 4804.639731),
        (1600, 5732.808769),
        (1800, 6228.236688),
        (2000, 7206.959596),
        (2200, 9172.494031),
        (2400, 9554.681282),
        (2600, 10779.64042),
        (2800, 12011.59933),
        (3000, 14013.53255),
        (3500, 16015.46577),
        (4000, 18017.39899),
        (4500, 23852.82136),
        (5000, 21020.29882),
        (5500, 22931.23508),
        (6000, 28027.06509),
        (6500, 28745.70779),
        (7000, 32098.9),
        (7500, 34504.4),
        (8000, 36909.9),
        (8500, 39315.4),
        (9000, 41720.9),
        (9500, 44126.4),
        (10000, 46531.9),
    ]
)


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
    fir /= np.abs(scipy.fft.fft(fir)).max()
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
    magnitude = np.maximum(np.abs(scipy.fft.fft(fir)), np.finfo(np.float64).tiny)
    phase = -np.imag(scipy.signal.hilbert(np.log(magnitude)))
    response: FloatArray = scipy.fft.ifft(magnitude * np.exp(1j * phase)).real
    return response
