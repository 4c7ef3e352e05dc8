"""`rosafe.Head`: a head as its impulse responses around the horizontal plane; rendering and interaural cues."""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from fractions import Fraction
from typing import Any

import numpy as np
import scipy.signal

from rosafe.declarations.checks import is_number
from rosafe.declarations.text import short_repr
from rosafe.dsp.erb import bandwidth
from rosafe.dsp.numeric_limits import LIMIT, FloatArray, as_numbers
from rosafe.localization import angles
from rosafe.localization.filters import HOP, HeadFilters, SourceRenderer
from rosafe.localization.pair import MAX_SPACING, MIN_SPACING, PREFIX, pair_filters
from rosafe.localization.sofa import MAX_NUMBERS, MAX_RATE, MIN_RATE, read_sofa
from rosafe.localization.sphere import SPEED_OF_SOUND, sphere_filters
from rosafe.system.terminal import printable

_SYMMETRY = 1e-6  # of the energy; below, two ears count as mirrored
_CUE_RATE = 48000.0  # Hz, at which the cues of computed heads are computed
_MAX_ITD = 0.0012  # s, of a head
_MAX_FILTERS = 4  # sample rates whose filters are kept


class Head:
    """A head: impulse responses of both ears for directions in the horizontal plane.

    Create it by `Head.sphere`, `Head.pair` or `Head.from_sofa`.

    Parameters
    ----------
    name : str
        `sphere`, `pair:` and the spacing in m, or the path of the SOFA file.
    azimuths : ndarray, (A,)
        Measured directions in degrees, left positive, ascending in (-180, 180].
    responses : ndarray, (A, 2, N), or None
        Impulse responses of the left and the right ear; None if they are computed.
    sample_rate : float
        Of the responses, Hz.
    front_only : bool
        Whether the responses cover the front half only.
    spacing : float, optional
        Of two microphones without a head, m.

    Attributes
    ----------
    spacing : float or None
        Distance of two microphones without a head, m; None for a head.
    front_only : bool
        Whether the responses cover the front half (-90 to 90 degrees) only.

    Examples
    --------
    >>> import numpy as np, rosafe
    >>> head = rosafe.Head.sphere()
    >>> ears = head.render(np.random.default_rng(1).standard_normal(8000), 16000, azimuth=60)
    >>> ears.shape, bool(np.std(ears[0]) > np.std(ears[1]))
    ((2, 8000), True)
    """

    def __init__(
        self,
        name: str,
        azimuths: FloatArray,
        responses: FloatArray | None,
        sample_rate: float,
        front_only: bool = False,
        spacing: float | None = None,
    ) -> None:
        self.name = name
        self.azimuths = azimuths
        self.front_only = front_only
        self.spacing = spacing
        self._responses = responses
        self._rate = sample_rate
        self._filters: dict[float, HeadFilters] = {}  # by sample rate; replaced, not modified: threads may share it

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_filters": {}}  # filters are larger than the responses, and quickly made

    @classmethod
    def sphere(cls) -> Head:
        """Return a rigid sphere with a radius of 8.75 cm and ears at -90 and 90 degrees.

        The responses are those of R. O. Duda and W. L. Martens (1998), J. Acoust. Soc. Am. 104, 3048-3058, for plane
        waves.
        """
        return cls("sphere", angles.grid(), None, _CUE_RATE)

    @classmethod
    def pair(cls, spacing: float) -> Head:
        """Return two omnidirectional microphones at -90 and 90 degrees without a head between them.

        Plane waves reach the microphones with equal levels and with a time difference of spacing / c * sin(azimuth),
        where c is 343 m/s.

        Parameters
        ----------
        spacing : float
            Distance of the microphones in m, 0.01 to 1. Localization needs a delay, spacing / c, of at most
            `cc_maxDelaySec`: 0.377 m by default.

        Raises
        ------
        ValueError
            For another spacing.
        """
        if not is_number(spacing) or not MIN_SPACING <= spacing <= MAX_SPACING:
            raise ValueError(
                f"spacing: expected a distance of the microphones from {MIN_SPACING:g} to {MAX_SPACING:g} m, "
                f"got {short_repr(spacing)}"
            )
        return cls(f"{PREFIX}{spacing:g}", angles.grid(), None, _CUE_RATE, spacing=float(spacing))

    @classmethod
    def from_sofa(cls, path: str | os.PathLike[str], mirror: bool | None = None) -> Head:
        """Read a head from a SOFA file with the convention SimpleFreeFieldHRIR (AES69).

        Parameters
        ----------
        path : str or Path
            The file. Each direction is the measurement nearest to the horizontal plane, at most 3 degrees from it and
            within 5 % of the distance that most directions have. The directions must surround the head, or cover the
            front half (-90 to 90 degrees), with gaps of at most 30 degrees.
        mirror : bool, optional
            Whether the labels of the file are wrong: its ears are exchanged if it labels the right ear first, and its
            azimuths are negated otherwise. By default they are wrong if sources at the sides are at least 3 dB louder
            in the farther ear at 4 to 8 kHz.

        Raises
        ------
        ValueError
            The file is missing, damaged, no SOFA file or unsuitable: one line that names it.

        Warns
        -----
        UserWarning
            If labels are corrected, or directions are left out: one line.
        """
        if mirror is not None and not isinstance(mirror, bool):
            raise ValueError(f"mirror: expected True, False or None, got {short_repr(mirror)}")
        read = read_sofa(path, mirror)
        if read.notes:
            warnings.warn(f"{printable(os.fspath(path))}: {'; '.join(read.notes)}", UserWarning, stacklevel=2)
        return cls(os.fspath(path), read.azimuths, read.responses, read.sample_rate, read.front_only)

    def __repr__(self) -> str:
        return f"<Head {self.name}: {len(self.azimuths)} directions>"

    @property
    def front_back_equal(self) -> bool:
        """Whether directions behind count as equal to their front images: azimuths are then in the front half."""
        return self._responses is None or self.front_only

    def check_azimuths(self, azimuths: FloatArray) -> None:
        """Raise ValueError if the head has no responses for one of the azimuths (degrees)."""
        outside = np.abs(angles.wrap(azimuths)) > 90.0 + 1e-9
        if self.front_only and np.any(outside):
            value = float(np.ravel(angles.wrap(azimuths))[np.ravel(outside)][0])
            raise ValueError(
                f"azimuth: expected -90 to 90 degrees, which {printable(self.name)} covers, got {value:g}; "
                "use a head that is measured all around"
            )

    @property
    def key(self) -> str:
        """A digest of the responses, equal for equal heads."""
        computed = "" if self._responses is not None else f"sphere {self.spacing}"
        digest = hashlib.sha256(f"{self._rate} {computed}".encode())
        if self._responses is not None:
            digest.update(self.azimuths.tobytes())
            digest.update(np.ascontiguousarray(self._responses).tobytes())
        return digest.hexdigest()

    def is_symmetric(self) -> bool:
        """Return whether the responses at -a are those at a with the ears exchanged, for all azimuths a."""
        if self._responses is None:
            return True
        mirrored = angles.wrap(-self.azimuths)
        order = np.argsort(mirrored)
        if not np.allclose(mirrored[order], self.azimuths, atol=1e-3):
            return False
        swapped = self._responses[order][:, ::-1]
        return bool(np.sum((swapped - self._responses) ** 2) <= _SYMMETRY * np.sum(self._responses**2))

    def check_delay(self, limit: float) -> None:
        """Raise ValueError if the delay of a pair exceeds `cc_maxDelaySec`, the `limit` in s."""
        if self.spacing is not None and self.spacing > limit * SPEED_OF_SOUND:
            raise ValueError(
                f"head: expected a spacing of at most {limit * SPEED_OF_SOUND:.3g} m, the way of sound in "
                f"cc_maxDelaySec ({limit:g} s), got {self.spacing:g} m; raise cc_maxDelaySec to at least "
                f"{math.ceil(self.spacing / SPEED_OF_SOUND * 1e5) / 1e5:g}, or use closer microphones"
            )

    def filters(self, sample_rate: float) -> HeadFilters:
        """Return the filters at a sample rate (Hz)."""
        rate = checked_rate(sample_rate)
        filters = self._filters.get(rate)
        if filters is None:
            filters = self._make_filters(rate)
            self._filters = dict([*self._filters.items(), (rate, filters)][-_MAX_FILTERS:])
        return filters

    def _make_filters(self, sample_rate: float) -> HeadFilters:
        if self._responses is None:
            return sphere_filters(sample_rate) if self.spacing is None else pair_filters(self.spacing, sample_rate)
        ratio = Fraction(sample_rate / self._rate).limit_denominator(1000)
        responses = self._responses
        numbers = math.ceil(responses.size * ratio)
        if numbers > MAX_NUMBERS:
            raise ValueError(
                f"{printable(self.name)}: expected responses of at most {MAX_NUMBERS} numbers at {sample_rate:g} Hz, "
                f"got {numbers}; use a head with fewer directions or shorter responses, or a lower sample rate"
            )
        if ratio != 1:
            responses = scipy.signal.resample_poly(responses, ratio.numerator, ratio.denominator, axis=-1) / float(
                ratio
            )
        return HeadFilters(self.azimuths, responses, front_only=self.front_only)

    def render(self, signal: Any, sample_rate: float, azimuth: Any) -> FloatArray:
        """Render a signal at a direction.

        Parameters
        ----------
        signal : array_like, (N,)
            The sound of the source.
        sample_rate : float
            In Hz.
        azimuth : float or array_like, (N,)
            Degrees relative to the head, left positive; one per sample for a source that moves. A moving direction is
            taken every 256 samples and interpolated without clicks.

        Returns
        -------
        ndarray, (2, N)
            Left and right ear. The delays of the responses are included.

        Raises
        ------
        ValueError
            For a signal that is not one-dimensional and finite, or an azimuth of another shape.
        """
        samples = np.asarray(signal)
        if samples.ndim != 1 or samples.dtype.kind not in "iuf":
            raise ValueError(f"signal: expected numbers of shape (N,), got {samples.dtype} of shape {samples.shape}")
        samples = samples.astype(np.float64)
        if not (np.abs(samples) <= LIMIT).all():
            raise ValueError(f"signal: expected finite samples up to {LIMIT:g}, got larger ones, NaN or infinity")
        filters = self.filters(sample_rate)
        directions = _checked_azimuth(azimuth, samples.shape)
        self.check_azimuths(directions)
        if not len(samples):
            return np.empty((2, 0))
        if directions.ndim == 0:
            response = filters.response(float(angles.wrap(directions)))
            return np.asarray(scipy.signal.oaconvolve(samples[np.newaxis], response, axes=-1)[:, : len(samples)])
        hops = -(-len(samples) // HOP)
        padded = np.zeros(hops * HOP)
        padded[: len(samples)] = samples
        at_hops = directions[np.minimum(np.arange(hops + 1) * HOP, len(samples) - 1)]
        return SourceRenderer(filters).process(padded, angles.wrap(at_hops))[:, : len(samples)]

    def itd(self, frequencies: Any, azimuths: Any = None) -> FloatArray:
        """Return interaural time differences (A, C) in s, positive if the left ear hears later.

        Parameters
        ----------
        frequencies : array_like, (C,)
            Centre frequencies in Hz. The ITD is the lag of the maximum of the cross-correlation of both responses
            behind a filter with the equivalent rectangular bandwidth.
        azimuths : array_like, (A,), optional
            Degrees; the measured directions by default.
        """
        return self._cues(frequencies, azimuths)[0]

    def ild(self, frequencies: Any, azimuths: Any = None) -> FloatArray:
        """Return interaural level differences (A, C) in dB, positive if the right ear is louder.

        Parameters
        ----------
        frequencies : array_like, (C,)
            Centre frequencies in Hz, of filters as for `itd`.
        azimuths : array_like, (A,), optional
            Degrees; the measured directions by default.
        """
        return self._cues(frequencies, azimuths)[1]

    def _cues(self, frequencies: Any, azimuths: Any) -> tuple[FloatArray, FloatArray]:
        centers = np.atleast_1d(as_numbers("frequencies", frequencies))
        rate = self._rate
        if centers.ndim != 1 or not (np.isfinite(centers).all() and (centers > 0).all() and (centers < rate / 2).all()):
            raise ValueError(
                f"frequencies: expected values above 0 and below {rate / 2:g} Hz, got {short_repr(frequencies)}"
            )
        directions = np.atleast_1d(
            self.azimuths if azimuths is None else _checked_azimuth(azimuths, np.shape(azimuths))
        )
        filters = self.filters(rate)
        self.check_azimuths(directions)
        at = filters.at(angles.wrap(directions))
        bins = np.fft.rfftfreq(filters.size, 1 / rate)
        distance = (bins - centers[:, np.newaxis]) / (1.019 * np.asarray(bandwidth(centers))[:, np.newaxis])
        weights = (1 + distance**2) ** -4.0  # power response of a gammatone filter of order 4
        energies = np.einsum("aef,cf->eac", np.abs(at) ** 2, weights)
        size = 16 * filters.size
        reach = int(max(_MAX_ITD, 1.1 * (self.spacing or 0.0) / SPEED_OF_SOUND) * 16 * rate)
        lags = np.arange(-reach, reach + 1)
        cross = (at[:, 0] * np.conj(at[:, 1]))[:, np.newaxis] * weights
        itd = np.empty(cross.shape[:2])
        for row, spectrum in enumerate(cross):
            itd[row] = lags[np.fft.irfft(spectrum, size)[:, lags].argmax(axis=1)] / (16 * rate)
        return itd, 10 * np.log10(energies[1] / energies[0])


def computed_head(name: str) -> Head | None:
    """Return the head with a name, `sphere` or `pair:` and a spacing in m; None if the name is that of a file."""
    if name == "sphere":
        return Head.sphere()
    if not name.startswith(PREFIX):
        return None
    try:
        return Head.pair(float(name.removeprefix(PREFIX)))
    except ValueError:
        raise ValueError(
            f"head: expected {PREFIX} and the distance of the microphones from {MIN_SPACING:g} to {MAX_SPACING:g} m, "
            f"such as {PREFIX}0.058, got {short_repr(name)}"
        ) from None


def checked_rate(sample_rate: Any) -> float:
    """Return a sample rate in Hz; ValueError if it is not a number within the limits."""
    if not is_number(sample_rate) or not MIN_RATE <= sample_rate <= MAX_RATE:
        raise ValueError(f"sample_rate: expected {MIN_RATE:g} to {MAX_RATE:g} Hz, got {short_repr(sample_rate)}")
    return float(sample_rate)


def _checked_azimuth(azimuth: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return one azimuth, or a vector of the `shape`."""
    directions = np.asarray(azimuth)
    fits = directions.dtype.kind in "iuf" and directions.ndim <= 1 and directions.shape in ((), shape)
    if not fits or not angles.in_limits(directions):
        raise ValueError(
            f"azimuth: expected one finite number or a list of the right length, {angles.LIMITS}, "
            f"got {short_repr(azimuth)}"
        )
    return directions.astype(np.float64)
