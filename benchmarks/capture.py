"""Cost and regularity of capture: ``/usr/bin/python3 benchmarks/capture.py`` prints a table.

It runs a master, bass-ros and one subscriber (this process) on the loopback interface, with chunks of 50 ms at 44100 Hz
from a file. For each length of the window it measures: the share of a core used by bass; the deviation of the stamps
from a regular grid, and the delay of messages after their stamps (median / 99th percentile); the number of received
messages, and of frames that were in no window.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import report

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from rosafe.ros1.component import generate  # noqa: E402
from rosafe.ros1.transport.master import PrivateMaster  # noqa: E402

RATE, CHUNK = 44100, 2205
WINDOWS = (0.2, 1.0, 10.0, 60.0)  # s


class Received(NamedTuple):
    """A received message."""

    index: int
    frames: int  # in its window
    stamp: float  # s
    arrival: float


def cpu_seconds(pid: int) -> float:
    """Return the processor time that a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(call: Any, device: str, window: float, seconds: float, pid: int, received: list[Received]) -> list[str]:
    """Measure one length of the window and return a row of the table."""
    chunks = round(window * RATE / CHUNK)
    call("Acquire", device=device, sampleRate=RATE, nFramesPerChunk=CHUNK, nChunksOnPort=chunks)
    time.sleep(2.0)  # warm-up
    received.clear()
    begun, used = time.monotonic(), cpu_seconds(pid)
    time.sleep(seconds)
    share = (cpu_seconds(pid) - used) / (time.monotonic() - begun)
    messages = list(received)
    call("Stop")
    index = np.array([item.index for item in messages])
    stamp = np.array([item.stamp for item in messages])
    grid = stamp[0] + (index - index[0]) / RATE
    jitter = np.abs(stamp - grid - np.median(stamp - grid)) * 1e3
    delay = np.array([item.arrival - item.stamp for item in messages]) * 1e3
    lost = np.maximum(0, np.diff(index) - messages[0].frames).sum()
    return [
        f"{window:g} s",
        f"{100 * share:.1f} %",
        f"{np.median(jitter):.3f} / {np.percentile(jitter, 99):.3f}",
        f"{np.median(delay):.1f} / {np.percentile(delay, 99):.1f}",
        f"{len(messages)} of {round((index[-1] - index[0]) / CHUNK) + 1}",
        f"{lost}",
    ]


def main() -> None:
    """Measure all lengths of the window."""
    parser = report.arguments("Measure the cost and the regularity of capture.")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each window (default: %(default)s)")
    options = parser.parse_args()
    page = report.Report(options, "Capture")
    generate.ensure_messages()
    with PrivateMaster() as master, tempfile.TemporaryDirectory() as folder:
        os.environ.update(ROS_MASTER_URI=master.uri, ROS_IP="127.0.0.1", ROS_HOME=folder)
        import rospy
        import rosservice
        import soundfile

        from rosafe.ros1.component import serialization

        noise = np.random.default_rng(0).integers(-(2**15), 2**15, (10 * RATE, 2)).astype(np.int16)
        soundfile.write(f"{folder}/noise.wav", noise, RATE)
        with subprocess.Popen([str(ROOT / "scripts" / "bass-ros")], stderr=subprocess.DEVNULL) as bass:
            try:
                rospy.init_node("benchmark", disable_signals=True)
                received: list[Received] = []

                def receive(message: Any) -> None:
                    stamp = message.stamp["sec"] + message.stamp["nsec"] * 1e-9
                    received.append(Received(message.lastFrameIndex, len(message.left), stamp, time.time()))

                def call(service: str, **fields: Any) -> None:
                    rospy.wait_for_service(f"/bass/{service}", 20)
                    kind = rosservice.get_service_class_by_name(f"/bass/{service}")
                    answer = rospy.ServiceProxy(f"/bass/{service}", kind)(**fields)
                    if not answer.genom_success:
                        sys.exit(f"{service}: {answer.genom_exdetail}")

                audio = serialization.message_class("bass", "::binaudio::portStruct")
                rospy.Subscriber("/bass/Audio", audio, receive, queue_size=1, buff_size=2**26, tcp_nodelay=True)
                device = f"file:{folder}/noise.wav?loop=1"
                rows = [measure(call, device, window, options.seconds, bass.pid, received) for window in WINDOWS]
                page.table(["window", "of a core", "stamps off (ms)", "delay (ms)", "messages", "lost"], rows)
                page.write("capture.md")
                rospy.signal_shutdown("done")
            finally:
                bass.terminate()


if __name__ == "__main__":
    main()
