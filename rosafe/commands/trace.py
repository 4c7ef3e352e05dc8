"""Trace the concurrent work of processors, in a running rosAFE node or on a sound file.

Prints the share of time that each processor spends in the four states of the user guide (waitExec, exec, waitRelease,
release), the load of each worker, and for how long parents, children and siblings compute concurrently. With -o, all
steps are written to a file for https://ui.perfetto.dev and chrome://tracing, with a row for each processor and worker
and the numbers of the blocks. ROSAFE_WORKERS sets the number of workers.

Without SOUND the command subscribes to a node, which traces only during the subscription. A node that keeps up waits
for sound most of the time, and a parent is idle while its children work. With SOUND, a file with two channels, the
default tree computes at full speed without ROS. Ctrl-C ends the trace early.

examples:
  rosafe trace --seconds 10 -o trace.json
  rosafe trace speech.wav -o trace.json"""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import re
import sys
import time
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError
from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK, MAX_FRAMES_PER_BLOCK
from rosafe.system import option_types
from rosafe.system.output import new_file
from rosafe.system.terminal import printable

if TYPE_CHECKING:
    from rosafe.tree.trace import Event

_ANSWER_SECONDS = 3.0  # for a node to notice the subscription, and between two of its messages
_MIN_SECONDS, _MAX_SECONDS = 1e-3, 3600.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "sound", nargs="?", type=Path, metavar="SOUND", help="trace the computation of this file, without ROS"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the trace to FILE as JSON")
    parser.add_argument(
        "--seconds",
        type=option_types.seconds(_MIN_SECONDS, _MAX_SECONDS),
        default=5.0,
        metavar="S",
        help="duration of the trace, or of the sound (default: %(default)g)",
    )
    parser.add_argument("--node", default="rosAFE", metavar="NAME", help="name of the node (default: %(default)s)")
    parser.add_argument(
        "--block",
        type=option_types.whole_number(1, MAX_FRAMES_PER_BLOCK),
        default=DEFAULT_FRAMES_PER_BLOCK,
        metavar="N",
        help="frames per block of SOUND (default: %(default)s)",
    )
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")


def run(options: argparse.Namespace) -> int:
    """Trace a node or a computation, write the file and print the summary."""
    output: Path | None = options.output
    with nullcontext() if output is None else new_file(output, options.force) as descriptor:
        if options.sound is not None:
            title, events = printable(options.sound), _compute(options.sound, options.seconds, options.block)
        else:
            from rosgraph.names import get_ros_namespace, ns_join

            title = ns_join(get_ros_namespace(), options.node.rstrip("/"))
            if not re.fullmatch(r"(/[A-Za-z]\w*)+", title, re.ASCII):
                raise CommandError(f"--node: expected the name of a node, such as rosAFE, got {options.node!r}")
            events = _listen(title, options.seconds)
        from rosafe.tree.trace import Trace

        trace = Trace(events)
        if not trace.intervals:
            raise CommandError(f"{title} has no processors; create some first")
        if descriptor is not None:
            with os.fdopen(descriptor, "w", encoding="utf-8", closefd=False) as stream:
                json.dump(trace.chrome(title), stream)
    print(f"{printable(title)}, {(trace.end - trace.begin) / 1e6:.2f} s")
    print("\n".join(map(printable, trace.summary())))
    if output is not None:
        print(f"written to {printable(output)}, which https://ui.perfetto.dev shows")
    return 0


def _compute(path: Path, seconds: float, block: int) -> list[Event]:
    """Return the events of the default tree for the first `seconds` of a sound file."""
    from rosafe.audio.files.audiofile import AudioFile, AudioFileError
    from rosafe.interface import CORE_REPRESENTATIONS
    from rosafe.interface.arguments import check_parameters
    from rosafe.processing.chain import Chain
    from rosafe.tree.trace import Tracer

    tracer = Tracer()
    try:
        with closing(AudioFile(path)) as sound:
            if sound.channels != 2:
                raise CommandError(f"{path}: expected two channels, left and right ear, got {sound.channels}")
            if sound.remark:
                print(f"rosafe trace: {printable(sound.remark)}", file=sys.stderr)
            frames = min(sound.frames, math.ceil(seconds * sound.sample_rate))
            blocks = (sound.read(min(block, frames - first)) for first in range(0, frames, block))
            values = {"in_doNormalize": True, **check_parameters(None)}
            with Chain(blocks, sound.sample_rate, values, CORE_REPRESENTATIONS, lambda *_: None) as chain:
                chain.observe(tracer)
                chain.run()
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    return tracer.take()


def _listen(node: str, seconds: float) -> list[Event]:
    """Return the events that the node publishes within `seconds`, or until Ctrl-C."""
    import rospy
    from std_msgs.msg import String

    from rosafe.ros1.afe.trace_port import read
    from rosafe.ros1.component.startup import become_node

    messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
    become_node("rosafe_trace")
    subscriber = rospy.Subscriber(f"{node}/trace", String, messages.put, tcp_nodelay=True)
    received: list[Any] = []
    try:
        try:
            received.append(messages.get(timeout=_ANSWER_SECONDS))
        except queue.Empty:
            raise CommandError(f"{node} does not publish a trace; check that a rosAFE-ros has this name") from None
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            received.append(messages.get(timeout=left + _ANSWER_SECONDS))
    except queue.Empty:
        print(f"rosafe trace: {printable(node)} has stopped publishing", file=sys.stderr)
    except KeyboardInterrupt:
        if not received:
            raise
        print("rosafe trace: ended early", file=sys.stderr)
    finally:
        subscriber.unregister()
    while not messages.empty():  # received before Ctrl-C
        received.append(messages.get())
    return [event for message in received for event in read(message)]
