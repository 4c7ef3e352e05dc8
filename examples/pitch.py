"""Estimate the pitch of a voice from the autocorrelations of all channels: pitch.py [SOUND]; mono files work, too."""

import sys

import numpy as np
import soundfile

import rosafe

if len(sys.argv) > 1:
    sound, rate = soundfile.read(sys.argv[1])
else:  # a buzz that glides from 150 to 300 Hz
    rate = 16000
    frequency = np.linspace(150, 300, 2 * rate)
    sound = 0.1 * (np.cumsum(frequency) / rate % 1 < 0.1)

result = rosafe.process(sound, rate, parameters=rosafe.PRESETS["speech"], outputs="pitch")
pitch = result["pitch"][0, 0]  # Hz; NaN: no pitch
for at in np.arange(0.25, result["pitch_time"][-1], 0.5):
    near = np.abs(result["pitch_time"] - at) < 0.1
    voiced = pitch[near][np.isfinite(pitch[near])]
    print(f"{at:.2f} s: " + (f"{np.median(voiced):.0f} Hz" if voiced.size else "no pitch"))
