"""The level of the steady noise, stored by `rosafe localize --calibrate-noise`."""

from __future__ import annotations

import os
from pathlib import Path

from rosafe.localization import model_cache
from rosafe.localization.live import OK, WARN, Status
from rosafe.localization.localizer import Localizer
from rosafe.localization.noise import NoiseCalibration
from rosafe.system.trust import foreign

NO_FILE = "none"  # the value of ~noise without a file
# Levels of 0.1 s after which sound that has been steady since the start is noise. In a recording it may be a source.
WARM_UP = 2


def default_path() -> Path | None:
    """Return the file that is used if no other is named; None without a cache folder of this user alone."""
    folder = model_cache.folder()
    path = folder / "noise.json" if folder else None
    return None if path is None or path.is_symlink() or foreign(path) else path


def file_of(setting: str) -> Path | None:
    """Return the file for a value of ~noise; None if no file is to be used."""
    if setting == NO_FILE:
        return None
    return Path(os.path.expanduser(setting)) if setting else default_path()


class StoredNoise:
    """The noise level that the node uses, besides the one that it measures.

    Parameters
    ----------
    setting : str
        The file, `NO_FILE`, or empty: the default file if it exists.
    status : Status
        Reports which file is used, and if it cannot be used.

    Raises
    ------
    ValueError
        The file that `setting` names is missing or damaged: one line.
    """

    def __init__(self, setting: str, status: Status) -> None:
        self._status = status
        self._calibration: NoiseCalibration | None = None
        status.value("noise calibration", NO_FILE)
        path = file_of(setting)
        if path is None or not (setting or path.exists()):
            return
        try:
            self._calibration = NoiseCalibration.load(path)
        except ValueError as problem:
            if setting:
                raise
            status.set("noise", WARN, f"the noise calibration is not used: {problem}; repeat it")
        else:
            status.value("noise calibration", path)

    def apply(self, localizer: Localizer) -> None:
        """Give the level to a localizer; if it was measured with other parameters, it is not used."""
        localizer.noise.warm_up = WARM_UP
        if self._calibration is None:
            return
        try:
            self._calibration.check(localizer.model.sample_rate, localizer.model.parameters)
            channels, found = localizer.model.channels, len(self._calibration.level_db)
            if found != channels:
                raise ValueError(f"level_db: expected {channels} levels, got {found}")
        except ValueError as problem:
            self._status.set("noise", WARN, f"the noise calibration is not used: {problem}; repeat it")
            return
        localizer.noise.stored = self._calibration.level_db
        self._status.set("noise", OK, "the noise calibration is used", log=False)
