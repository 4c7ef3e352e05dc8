"""Cost and latency of the localizer node, measured in another process.

``/usr/bin/python3 benchmarks/localizer_node.py`` starts real nodes with a private master and a scene with two talkers,
with sound at 44.1 kHz in blocks of 2205 frames. It reports the processor time of the localizer and of rosAFE, the time
of publication minus `header.stamp`, and the time from the onset of a source on /bass/sceneTruth until it is present.
Only synthetic sound is used. The first run learns the model of the sphere.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from pathlib import Path

import graph
import numpy as np
import soundfile
from report import Report, arguments

SECONDS = 60.0  # of a measurement
SETTLE_SECONDS = 10.0
ONSETS = tuple(range(4, 60, 8))  # s in the scene
TALK_SECONDS = 4  # from each onset
PRESENT = 0.5
START_SECONDS = 120.0  # including the model


def write_scene(folder: Path) -> Path:
    """Write a scene: a talker all the time, and another one every 8 s for 4 s, from another direction each time.

    Each has a sound of its own: equal sounds from two directions are heard from a direction between them.
    """
    random = np.random.default_rng(1)
    sources = ["{name: constant, file: constant.wav, loop: true, level_db: -30, azimuth: -60}"]
    for number, onset in enumerate(ONSETS):
        azimuth = -20 + 80 * number / (len(ONSETS) - 1)
        sources.append(
            f"{{name: s{number}, file: s{number}.wav, level_db: -25, azimuth: {azimuth:.0f}, start: {onset}, "
            f"end: {onset + TALK_SECONDS}}}"
        )
    for name, seconds in (("constant", 10), *((f"s{number}", TALK_SECONDS) for number in range(len(ONSETS)))):
        levels = np.repeat(10 ** (random.uniform(-20, 0, 10 * seconds) / 20), graph.RATE // 10)
        soundfile.write(folder / f"{name}.wav", 0.1 * levels * random.standard_normal(len(levels)), graph.RATE)
    path = folder / "scene.yaml"
    path.write_text("seed: 1\nnoise: {snr_db: 30}\nsources:\n" + "".join(f"  - {source}\n" for source in sources))
    return path


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def onset_delays(truths: list, sources: list) -> list[float]:
    """Return for each onset the seconds from its first truth to the end of the frames with which it is present."""
    begins: dict[str, tuple[float, float]] = {}
    for truth in truths:
        for name, azimuth in zip(truth.names, truth.azimuths, strict=True):
            begins.setdefault(name, (truth.stamp.to_sec(), azimuth))
    delays = []
    for name, (begin, azimuth) in begins.items():
        if name != "constant":
            delays += [
                message.header.stamp.to_sec() - begin
                for message in sources
                if begin < message.header.stamp.to_sec() < begin + TALK_SECONDS
                and any(
                    s.probability > PRESENT and abs(s.azimuth - azimuth) < math.radians(12) for s in message.sources
                )
            ][:1]
    return delays


def measure() -> dict[str, float]:
    """Return the figures."""
    import rospy

    received: list[tuple[float, object]] = []
    truths: list[object] = []
    with tempfile.TemporaryDirectory() as folder, graph.bench() as bench:
        from geometry_msgs.msg import PoseArray
        from rosAFE.msg import SoundSources

        from bass.msg import SceneTruth

        scene = write_scene(Path(folder))
        bench.start_sound(2205, f"scene:{scene}")
        bench.call("/rosAFE/InputProc", nFramesPerBlock=2205)
        afe = bench.pid("/rosAFE")
        begin = processor_seconds(afe)
        time.sleep(SETTLE_SECONDS)
        idle = (processor_seconds(afe) - begin) / SETTLE_SECONDS
        topic = "/localizer/sources"
        sources = rospy.Subscriber(topic, SoundSources, lambda m: received.append((rospy.get_time(), m)))
        rospy.Subscriber("/bass/sceneTruth", SceneTruth, truths.append)
        node = bench.start("rosafe", "localize")
        bench.session.wait(
            lambda: "localizing with" in node.err, f"the localizer does not start: {node.err}", START_SECONDS
        )
        bench.call(
            "/bass/Acquire", device=f"scene:{scene}", sampleRate=graph.RATE, nFramesPerChunk=2205, nChunksOnPort=20
        )
        time.sleep(1.0)
        del received[:], truths[:]
        pids = {"localizer": node.process.pid, "rosAFE": afe}
        before = {name: processor_seconds(pid) for name, pid in pids.items()}
        time.sleep(SECONDS)
        used = {name: (processor_seconds(pid) - before[name]) / SECONDS for name, pid in pids.items()}
        messages = list(received)
        latency = [now - m.header.stamp.to_sec() for now, m in messages if m.sources]
        delays = onset_delays(list(truths), [m for _, m in messages])
        rospy.Subscriber("/localizer/poses", PoseArray, lambda message: None)
        sources.unregister()
        bench.call(
            "/bass/Acquire", device=f"scene:{scene}", sampleRate=graph.RATE, nFramesPerChunk=2205, nChunksOnPort=20
        )
        time.sleep(SETTLE_SECONDS)
        begin = processor_seconds(node.process.pid)
        time.sleep(SECONDS - SETTLE_SECONDS)
        without_speech = (processor_seconds(node.process.pid) - begin) / (SECONDS - SETTLE_SECONDS)
    return {
        "messages per second": len(messages) / SECONDS,
        "processor time of the localizer, % of a core": 100 * used["localizer"],
        "the same without speech: only ~poses is subscribed, % of a core": 100 * without_speech,
        "additional processor time of rosAFE, % of a core": 100 * (used["rosAFE"] - idle),
        "publication - header.stamp, median, ms": 1000 * float(np.median(latency)),
        "publication - header.stamp, 99 %, ms": 1000 * float(np.percentile(latency, 99)),
        "onsets": len(ONSETS),
        "of these present": len(delays),
        "from the onset until present, median, s": float(np.median(delays)) if delays else math.nan,
    }


def add_to(report: Report) -> None:
    """Measure, and add a table to a report."""
    figures = graph.in_child(measure)
    rows = [[name, f"{value:.4g}"] for name, value in figures.items()]
    report.table(["localizer node, blocks of 2205 frames at 44.1 kHz", ""], rows)


def main() -> None:
    """Measure and write benchmarks/results/localizer_node.md."""
    options = arguments(str(__doc__).partition("\n")[0]).parse_args()
    report = Report(options, "The localizer node")
    add_to(report)
    report.write("localizer_node.md")


if __name__ == "__main__":
    main()
