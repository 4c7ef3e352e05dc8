"""Text of the speech in front of the robot: the stream of each source that speaks goes to a recognizer.

Start bass, rosAFE and `rosafe localize` first. `recognize` is called with the samples of an utterance (int16, 16 kHz):
replace it by any recognizer. This one uses vosk or pocketsphinx (pip install), if they are installed.
"""

import json
import math
from collections import deque

import numpy as np
import rospy
from rosAFE.msg import SoundSources, SourceAudio

FRONT = math.radians(30)
BEFORE = 1.0  # s: speech is noticed after its start
LATE = 3.0  # s, at most: sound arrives after the direction of its time
parts = deque(maxlen=10000)  # id, time and samples of each part of a stream, for about a minute
begins, ends = {}, {}  # by id, when those that speak have begun, and the others have ended
ended = deque()  # id, begin and end of utterances


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
    parts.append((part.id, part.header.stamp.to_sec(), np.array(part.samples, np.int16)))


def find_speakers(message):
    now = message.header.stamp.to_sec()
    front = {one.id for one in message.sources if one.speech > 0.5 and abs(one.azimuth) < FRONT}
    for id_ in front - begins.keys():
        begins[id_] = max(now - BEFORE, ends.get(id_, 0.0))
    for id_ in begins.keys() - front:
        ends[id_] = now
        ended.append((id_, begins.pop(id_), now))
    newest = parts[-1][1] if parts else 0.0
    while ended and (newest >= ended[0][2] or abs(now - ended[0][2]) > LATE):  # or the clock was set back
        id_, begin, end = ended.popleft()
        heard = [samples for one, time, samples in list(parts) if one == id_ and begin <= time < end]
        if heard:
            print(id_, recognize(np.concatenate(heard)), flush=True)


rospy.init_node("speech_to_text")
rospy.Subscriber("localizer/streams", SourceAudio, add_part, queue_size=200)
rospy.Subscriber("localizer/sources", SoundSources, find_speakers, queue_size=10)
rospy.spin()
