"""Comparisons of heads, `rosafe.localize` and `rosafe.enhance` with a sphere's series and with measured responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from math import pi
from typing import Any

import numpy as np
import scipy.signal
import scipy.special

from rosafe.declarations.reference import LITERATURE
from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization.enhancement import enhance
from rosafe.localization.head import Head
from rosafe.localization.localize import localize
from rosafe.validation.comparison import KEMAR, Collection, Measured, Origin, Process, altered, late
from rosafe.validation.kemar import head, response
from rosafe.validation.stimuli import TALKERS, largest, talker

ROWS = Collection()


# --- the rigid sphere --------------------------------------------------------------------------------------------


RADIUS, SOUND_SPEED = 0.0875, 343.0  # m, m/s
SPHERE_AZIMUTHS = np.arange(-90.0, 91, 15)
SPHERE_FREQUENCIES = np.array([200.0, 500, 1000, 2000, 3000, 5000, 8000])
SPHERE_RATE = 48000.0
SPECTRUM = 1 << 15  # points; frequencies are taken at the nearest of its lines


def sphere_responses(signal: Any, rate: float, parameters: Mapping[str, Any], outputs: Sequence[str]) -> dict[str, Any]:
    """Return `responses` (A, 2, N) of `Head.sphere` to `signal` at the azimuths of the validation; under test."""
    sphere = Head.sphere()
    return {"responses": np.stack([sphere.render(signal, rate, float(azimuth)) for azimuth in SPHERE_AZIMUTHS])}


def sphere_series(frequencies: FloatArray, incidence: FloatArray) -> FloatArray:
    """Return the pressure (F, A) at the surface over that in the free field at the centre, for a plane wave.

    Parameters
    ----------
    frequencies : ndarray (F,)
        In Hz.
    incidence : ndarray (A,)
        Angle between the ear and the source in radians.
    """
    size = 2 * pi * frequencies[:, np.newaxis] * RADIUS / SOUND_SPEED
    total = np.zeros((len(frequencies), len(incidence)), complex)
    for order in range(60):
        slope = scipy.special.spherical_jn(order, size, True) - 1j * scipy.special.spherical_yn(order, size, True)
        legendre = scipy.special.eval_legendre(order, np.cos(incidence))
        total += (2 * order + 1) * 1j ** (order - 1) * legendre / (size**2 * slope)
    return total


def sphere_ratios(process: Process) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the frequencies (F,), and the ratios right over left (F, A), by the series and of the responses."""
    lines = np.round(SPHERE_FREQUENCIES * SPECTRUM / SPHERE_RATE).astype(int)
    frequencies = lines * SPHERE_RATE / SPECTRUM
    found = process(np.eye(1, 4096)[0], SPHERE_RATE, {}, ["responses"])["responses"]
    spectra = np.fft.rfft(found, SPECTRUM)[..., lines]
    angles = np.radians(SPHERE_AZIMUTHS)
    left, right = (sphere_series(frequencies, np.arccos(side * np.sin(angles))) for side in (1, -1))
    return frequencies, right / left, (spectra[:, 1] / spectra[:, 0]).T


@ROWS.listed(
    altered("right ear louder by 0.15 dB", "responses", lambda values: values * [[1.0], [10 ** (0.15 / 20)]]),
    under_test=sphere_responses,
)
def sphere_levels(process: Process) -> Measured:
    frequencies, expected, found = (np.abs(values) for values in sphere_ratios(process))
    worst = largest(20 * np.log10(found / expected))
    at = int(np.flatnonzero(SPHERE_AZIMUTHS == 30)[0])
    levels = Measured.of(
        frequencies,
        20 * np.log10(expected[:, at]),
        20 * np.log10(found[:, at]),
        "frequency (Hz)",
        "ILD at 30° (dB)",
        True,
    )
    return Measured(worst, levels.curve)


@ROWS.listed(
    altered(
        "right ear late by a sample",
        "responses",
        lambda values: np.stack((values[:, 0], np.roll(values[:, 1], 1, -1)), 1),
    ),
    under_test=sphere_responses,
)
def sphere_delays(process: Process) -> Measured:
    frequencies, expected, found = sphere_ratios(process)
    low = frequencies < 3100
    errors = np.angle(found / expected)[low] / (2 * pi * frequencies[low, np.newaxis])
    delays = 1e6 * np.angle(expected[0]) / (2 * pi * frequencies[0])
    curve = Measured.of(SPHERE_AZIMUTHS, delays, delays + 1e6 * errors[0], "azimuth (degrees)", "ITD at 200 Hz (µs)")
    return Measured(1e6 * largest(errors), curve.curve)


# --- directions and enhancement ----------------------------------------------------------------------------------


RATE = 16000
DIRECTIONS = np.array([-75.0, -50, -25, 0, 20, 45, 70])
NOISE_DIRECTIONS = np.arange(-165.0, 181, 30)
SCENES = ((0.0, 60.0), (-30.0, 30.0))  # degrees, of the wanted talker and the other one


def rendered(sound: FloatArray, azimuth: float) -> FloatArray:
    """Return a sound from a direction of KEMAR, (2, N): measured responses, without the front-end's renderer."""
    ears = scipy.signal.resample_poly(response(azimuth), RATE, round(head().sample_rate), axis=-1)
    return scipy.signal.fftconvolve(ears, sound[np.newaxis], axes=-1)[:, : len(sound)]


def find(signal: Any, rate: float, parameters: Mapping[str, Any], outputs: Sequence[str]) -> dict[str, Any]:
    """Call `rosafe.localize` like `process`; under test."""
    return localize(signal, rate, parameters["head"], parameters["seconds"])


def select(signal: Any, rate: float, parameters: Mapping[str, Any], outputs: Sequence[str]) -> dict[str, Any]:
    """Call `rosafe.enhance` like `process`; under test."""
    return {"ears": enhance(signal, rate, parameters["azimuth"], parameters["head"])}


def azimuth_errors(process: Process, model: str, noisy: bool) -> FloatArray:
    """Return the absolute errors in degrees of all windows with an estimate, of a voice from each direction."""
    random, errors = np.random.default_rng(5), []
    for azimuth in DIRECTIONS:
        sound = rendered(talker(0), float(azimuth))
        if noisy:
            around = [random.standard_normal(sound.shape[1]) for _ in NOISE_DIRECTIONS]
            noise = np.sum([rendered(*pair) for pair in zip(around, NOISE_DIRECTIONS, strict=True)], axis=0)
            sound += noise * np.sqrt(np.mean(sound**2) / np.mean(noise**2))
        found = process(sound, RATE, {"head": model, "seconds": 0.5}, ["azimuth"])["azimuth"]
        errors.append((found[np.isfinite(found)] - azimuth + 180) % 360 - 180)
    return np.abs(np.concatenate(errors))


VOICES = f"a recorded voice from each of {len(DIRECTIONS)} directions of KEMAR"
NEEDED = (KEMAR, *TALKERS)
MEASURED_HEAD = Origin("directions of the measured impulse responses", LITERATURE["gardner1995"])


@ROWS.listed(altered("azimuth + 6°", "azimuth", lambda values: values + 6.0), under_test=find)
def matched_head(process: Process) -> float:
    return float(np.percentile(azimuth_errors(process, KEMAR, False), 95))


def noisy_error(process: Process, model: str) -> float:
    """Return the share of wrong windows in noise."""
    return float(np.mean(azimuth_errors(process, model, True) > 5))


for _model, _words in (
    (KEMAR, "model of KEMAR, all around"),
    ("sphere", "model of the sphere (the default), front half"),
):
    ROWS.limitation(
        "localize",
        f"{VOICES}, in equally loud noise from {len(NOISE_DIRECTIONS)} directions, {_words}: azimuth",
        MEASURED_HEAD,
        "of the windows",
        criterion="share of the windows with an estimate whose error is more than 5°",
        requires=NEEDED,
        under_test=find,
    )(partial(noisy_error, model=_model))


def si_sdr(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the scale-invariant signal-to-distortion ratio in dB of each ear (2,)."""
    scale = np.sum(estimate * reference, axis=-1) / np.sum(reference**2, axis=-1)
    target = scale[:, np.newaxis] * reference
    return np.asarray(10 * np.log10(np.sum(target**2, axis=-1) / np.sum((estimate - target) ** 2, axis=-1)))


@ROWS.listed(late("ears", 2), under_test=select)
def distortion(process: Process) -> float:
    gains = []
    for wanted, other in SCENES:
        target, disturbing = rendered(talker(0), wanted), rendered(talker(1), other)
        mixture = target + disturbing
        found = process(mixture, RATE, {"head": KEMAR, "azimuth": wanted}, ["ears"])["ears"]
        gains.append(float(np.mean(si_sdr(found, target) - si_sdr(mixture, target))))
    return -min(gains)
