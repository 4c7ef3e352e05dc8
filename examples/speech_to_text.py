"""Text of the speech in front of the robot: the stream of each source that speaks goes to a recognizer.

Start bass, rosAFE and `rosafe localize` first. `recognize` is called with the samples of an utterance (int16, 16 kHz):
replace it by any recognizer. This one uses vosk or pocketsphinx (pip install), if they are installed.
"""

import json
import math
from collections import defaultdict, deque

import numpy as np
import rospy
from rosAFE.msg import SoundSources, SourceAudio

FRONT = math.radians(30)
recent = defaultdict(lambda: deque(maxlen=50))  # by id, the parts of the last second: speech is noticed after its start
utterances = {}  # by id, the parts of those that speak


def recognize(samples):
    try:
        import vosk

        found = vosk.KaldiRecognizer(vosk.Model(lang="en-us"), 16000)
        found.AcceptWaveform(samples.tobytes())
        return json.loads(found.FinalResult())["text"]
    except ImportError:
        pass
    try:
        from pocketsphinx import Decoder

        found = Decoder(samprate=16000)
        found.start_utt()
        found.process_raw(samples.tobytes(), full_utt=True)
        found.end_utt()
        return found.hyp().hypstr if found.hyp() else ""
    except ImportError:
        return f"{len(samples) / 16000:.1f} s of speech; for text: pip install vosk"


def add_part(part):
    utterances.get(part.id, recent[part.id]).append(part)


def find_speakers(message):
    front = {one.id for one in message.sources if one.speech > 0.5 and abs(one.azimuth) < FRONT}
    for id_ in front - utterances.keys():
        utterances[id_] = list(recent.pop(id_, ()))
    for id_ in utterances.keys() - front:
        samples = [sample for part in utterances.pop(id_) for sample in part.samples]
        print(id_, recognize(np.array(samples, np.int16)), flush=True)


rospy.init_node("speech_to_text")
rospy.Subscriber("localizer/streams", SourceAudio, add_part, queue_size=200)
rospy.Subscriber("localizer/sources", SoundSources, find_speakers, queue_size=10)
rospy.spin()
