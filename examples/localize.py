"""Directions of the sources in a sound file, or of a simulated talker: localize.py [SOUND [HEAD.sofa]]"""

import sys

import numpy as np
import soundfile

import rosafe

head = sys.argv[2] if len(sys.argv) > 2 else "sphere"
if len(sys.argv) > 1:
    sound, rate = soundfile.read(sys.argv[1])
else:  # noise that moves from 60 degrees on the left to 60 degrees on the right
    rate = 16000
    noise = 0.05 * np.random.default_rng(1).standard_normal(4 * rate)
    sound = rosafe.Head.sphere().render(noise, rate, np.linspace(60, -60, len(noise)))

found = rosafe.localize(sound, rate, head)
for second in range(1, int(found["time"][-1]) + 1):
    now = np.abs(found["time"] - second).argmin()
    print(f"{second} s: {found['azimuth'][now]:+4.0f} degrees, confidence {found['confidence'][now]:.2f}")
for track in found["tracks"]:
    first, last = track["azimuth"][0], track["azimuth"][-1]
    print(
        f"source {track['id']}: {track['first_time']:.1f} to {track['last_time']:.1f} s, "
        f"{first:+.0f} to {last:+.0f} degrees"
    )
