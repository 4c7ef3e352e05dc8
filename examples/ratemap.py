"""Plot ratemaps and the level and time differences between the ears: ratemap.py [SOUND [PICTURE]]"""

import sys

import soundfile

import rosafe
from rosafe.audio.devices.scene import Scene

if len(sys.argv) > 1:
    sound, rate = soundfile.read(sys.argv[1])  # (N, 2)
else:
    sound, rate = Scene(16000).frames(3 * 16000), 16000  # a source that walks around the head
picture = sys.argv[2] if len(sys.argv) > 2 else "ratemap.png"

result = rosafe.process(sound, rate, parameters={"fb_nChannels": 48}, outputs=["ratemap", "ild", "itd"])
rosafe.plot(result).savefig(picture)
print(f"{result['ratemap'].shape[-1]} frames of {len(result['fb_cfHz'])} channels: {picture}")
