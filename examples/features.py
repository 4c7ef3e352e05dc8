"""Compute features of a sound for a classifier: means of outputs over time, with names and units: features.py [SOUND]

Needs xarray: pip install '.[files]' in the checkout
"""

import sys

import soundfile

import rosafe
from rosafe.audio.devices.scene import Scene

if len(sys.argv) > 1:
    sound, rate = soundfile.read(sys.argv[1])
else:
    sound, rate = Scene(16000).frames(2 * 16000), 16000

result = rosafe.process(sound, rate, outputs=["ratemap", "spectralFeatures", "onsetStrength", "ild"])
data = rosafe.to_xarray(result)
print("loudest channel:", float(data.ratemap.mean(["ear", "time"]).idxmax()), data.channel.units)
print("right ear:", round(float(data.ild.mean()), 1), data.ild.units)
for name in data.feature.values:
    print(f"{name}: {float(data.spectralFeatures.sel(ear='left', feature=name).mean()):.3g}")
