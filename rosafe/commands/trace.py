"""Show what the processors do at the same time: of a running rosAFE node, or on a sound file.

Prints, for each processor, its share of the time in the four states of the user guide (waitExec, exec, waitRelease,
release), for each worker how much of the time it computes, and for how long parents, children and siblings compute at
the same time. With -o, every step goes into a file that https://ui.perfetto.dev and chrome://tracing show: a row for
each processor and each worker, with the numbers of the blocks. ROSAFE_WORKERS says how many workers there are.

Without SOUND it listens to a node, which traces only while this command does. Where the node keeps up, it waits for
sound most of the time, and a parent has nothing to do while its children work. With SOUND, a file with two channels,
the default tree computes as fast as it goes, without ROS. Ctrl-C ends it early."""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import re
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.commands import CommandError
from rosafe.output import new_file
from rosafe.terminal import printable

if TYPE_CHECKING:
    from rosafe.tree.trace import Event

_ANSWER_SECONDS = 3.0  # for a node to find out that somebody listens, and between two of its messages
_MAX_SECONDS = 3600.0
_MAX_BLOCK = 10_000_000


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("sound", nargs="?", type=Path, metavar="SOUND", help="compute this file, without ROS")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the trace there, as JSON")
    parser.add_argument(
        "--seconds", type=_seconds, default=5.0, metavar="S", help="how long, or so much sound (default: %(default)g)"
    )
    parser.add_argument("--node", default="rosAFE", metavar="NAME", help="the instance (default: %(default)s)")
    parser.add_argument(
        "--block", type=_block, default=12000, metavar="N", help="frames per block of SOUND (default: %(default)s)"
    )
    parser.add_argument("--force", action="store_true", help="replace FILE if it is there")
    parser.epilog = "examples:\n  rosafe trace --seconds 10 -o trace.json\n  rosafe trace speech.wav -o trace.json"


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= _MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds up to {_MAX_SECONDS:g}")
    return value


def _block(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or not 1 <= int(text[:20]) <= _MAX_BLOCK:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {_MAX_BLOCK}")
    return int(text)


def run(options: argparse.Namespace) -> int:
    """Listen or compute, write, print."""
    output: Path | None = options.output
    with nullcontext() if output is None else new_file(output, options.force) as descriptor:
        if options.sound is not None:
            title, events = printable(options.sound), _compute(options.sound, options.seconds, options.block)
        else:
            title = f"/{options.node.strip('/')}"
            if not re.fullmatch(r"(/[A-Za-z]\w*)+", title, re.ASCII):
                raise CommandError(f"--node: expected the name of a node, such as rosAFE, got {options.node!r}")
            events = _listen(title, options.seconds)
        from rosafe.tree.trace import Trace

        trace = Trace(events)
        if not trace.spans:
            raise CommandError(f"{title} has no processors: nothing to trace")
        if descriptor is not None:
            with os.fdopen(descriptor, "w", encoding="utf-8", closefd=False) as stream:
                json.dump(trace.chrome(title), stream)
    print(f"{printable(title)}, {(trace.end - trace.begin) / 1e6:.2f} s")
    print("\n".join(map(printable, trace.summary())))
    if output is not None:
        print(f"written to {printable(output)}, which https://ui.perfetto.dev shows")
    return 0


def _compute(path: Path, seconds: float, block: int) -> list[Event]:
    """What the default tree does on the first `seconds` of a sound file."""
    from rosafe.interface import CORE_REPRESENTATIONS
    from rosafe.interface.arguments import check_parameters
    from rosafe.offline.chain import Chain
    from rosafe.sound.audiofile import AudioFile, AudioFileError
    from rosafe.tree.trace import Tracer

    tracer = Tracer()
    try:
        sound = AudioFile(path)
        try:
            if sound.channels != 2:
                raise CommandError(f"{path} has {sound.channels} channels, wanted are two: left and right ear")
            frames = min(sound.frames, math.ceil(seconds * sound.sample_rate))
            blocks = (sound.read(min(block, frames - first)) for first in range(0, frames, block))
            values = {"in_doNormalize": True, **check_parameters(None)}
            with Chain(blocks, sound.sample_rate, values, CORE_REPRESENTATIONS, lambda *_: None) as chain:
                chain.observe(tracer)
                chain.run()
        finally:
            sound.close()
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    return tracer.take()


def _listen(node: str, seconds: float) -> list[Event]:
    """What the node tells in so many seconds, or until Ctrl-C."""
    import rospy
    from std_msgs.msg import String

    from rosafe.component.startup import become_node
    from rosafe.node.trace_port import read
    from rosafe.transport.master import MasterError

    messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
    try:
        become_node("rosafe_trace")
    except MasterError as problem:
        raise CommandError(str(problem)) from None
    subscriber = rospy.Subscriber(f"{node}/trace", String, messages.put, tcp_nodelay=True)
    events: list[Event] = []
    try:
        try:
            events += read(messages.get(timeout=_ANSWER_SECONDS))
        except queue.Empty:
            raise CommandError(f"{node} does not answer: is there a rosAFE-ros of this name?") from None
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            events += read(messages.get(timeout=left + _ANSWER_SECONDS))
    except queue.Empty:
        print(f"rosafe trace: {printable(node)} has fallen silent", file=sys.stderr)
    except KeyboardInterrupt:
        if not events:
            raise
        print("rosafe trace: ended early", file=sys.stderr)
    finally:
        subscriber.unregister()
    return events
