"""Print the level difference between two microphones until Ctrl-C. Needs: pip install sounddevice"""

import numpy as np
import sounddevice

import rosafe

stream = rosafe.Stream(16000, outputs=["ild"])
with sounddevice.InputStream(samplerate=16000, channels=2, blocksize=1600) as microphones:
    while microphones.active:
        block, overflowed = microphones.read(1600)  # (1600, 2), float32
        ild = stream.process(block)["ild"]
        print(f"right ear {np.mean(ild):+5.1f} dB" + " (sound was lost)" * overflowed)
