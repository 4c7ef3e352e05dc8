"""Process sound block by block, here from a file of any length: stream_wav.py SOUND"""

import sys

import numpy as np
import soundfile

import rosafe

if len(sys.argv) != 2:
    sys.exit("usage: stream_wav.py SOUND")
path = sys.argv[1]
stream = rosafe.Stream(soundfile.info(path).samplerate, outputs=["ild"])
for block in soundfile.blocks(path, blocksize=1600):  # (n, 2)
    new = stream.process(block)
    if new["ild_time"].size:
        print(f"{new['ild_time'][-1]:7.3f} s: right ear {np.mean(new['ild']):+5.1f} dB")
