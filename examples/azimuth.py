"""Where the source is, from level differences and from the cross-correlation. azimuth.py [SOUND]"""

import sys

import numpy as np
import soundfile

import rosafe
from rosafe.bass.sources.scene import Scene
from rosafe.view.estimates import azimuth_from_correlation, azimuth_from_ild
from rosafe.view.representations import Representations

if len(sys.argv) > 1:
    sound, rate = soundfile.read(sys.argv[1])
else:
    sound, rate = Scene(16000).frames(4 * 16000), 16000

result = rosafe.process(sound, rate, outputs=["ratemap", "ild", "crossCorrelation"])
shown = Representations.from_process(result)
levels, lags = azimuth_from_ild(shown), azimuth_from_correlation(shown)
for second in range(int(shown.times[-1])):
    now = (shown.times >= second) & (shown.times < second + 1) & np.isfinite(levels) & np.isfinite(lags)
    if now.any():
        print(f"{second} s: {np.median(levels[now]):+4.0f} deg from levels, {np.median(lags[now]):+4.0f} deg from lags")
