"""`rosafe localize --calibrate-noise`: measure the level of the noise, for the node."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rosafe.dsp.numeric_limits import FloatArray
from rosafe.localization.noise import NoiseCalibration, measured_level
from rosafe.ros1.localizer.frame_listener import FrameListener, levels_of
from rosafe.system.terminal import printable

WAIT_SECONDS = 30.0  # that may pass, besides those of the noise, while frames are missing
UNSTEADY_DB = 8.0  # of the loudest frames above the median


def calibrate(listener: FrameListener, seconds: float, path: Path, say: Callable[[str], None]) -> NoiseCalibration:
    """Measure the noise for `seconds`, and write its level to a file.

    Raises
    ------
    NoFramesError
        rosAFE computes no frames.
    OutputError
        The file cannot be written.
    """
    say(f"measuring the noise for {seconds:g} s: no other sounds, please")
    parts: list[FloatArray] = []
    hop, frames = 0.0, 0
    for model, new in listener.listen(seconds + WAIT_SECONDS):
        hop = float(model.parameters["cc_hSizeSec"])
        parts.append(levels_of(model, new))
        frames += len(new.middles)
        if frames * hop >= seconds:
            break
    levels = np.concatenate(parts)
    level = measured_level(levels)
    calibration = NoiseCalibration(model.sample_rate, model.parameters, level)
    calibration.save(path)
    total = 10 * np.log10(np.sum(10 ** (levels / 10), axis=1)) + model.level_gain_db
    mean = 10 * np.log10(np.mean(10 ** (total / 10)))
    say(f"noise level {mean:.1f} dB full scale, from {frames * hop:.1f} s of sound; written to {printable(path)}")
    if np.quantile(total, 0.98) > np.median(total) + UNSTEADY_DB:
        say("the level was not steady: if there were other sounds than the noise, repeat the calibration")
    return calibration
