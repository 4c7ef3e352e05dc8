"""The rotation between two coordinate frames from transforms of a robot, as tf2 computes it, without ROS."""

from __future__ import annotations

import bisect
import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from rosafe.system.terminal import printable

CACHE_SECONDS = 10.0  # of rotations
MAX_FRAMES = 1000  # coordinate frames
MAX_NAME = 256  # characters of the name of a coordinate frame
MAX_ROTATIONS = 20_000  # of one coordinate frame
_NORM_TOLERANCE = 1e-2  # of a quaternion, as in tf2
_PARALLEL = 1.0 - 1e-9  # of the product of two quaternions that are interpolated linearly

Quaternion = tuple[float, float, float, float]  # x, y, z, w


class Turn(NamedTuple):
    """A rotation of a coordinate frame relative to its parent, at a time in s."""

    time: float
    rotation: Quaternion


class CoordinateFrame:
    """A coordinate frame: its parent, and its rotations in the order of their times."""

    def __init__(self, parent: str, static: bool) -> None:
        self.parent, self.static = parent, static
        self.turns: deque[Turn] = deque(maxlen=1 if static else MAX_ROTATIONS)

    def add(self, turn: Turn) -> None:
        turns = self.turns
        if not turns or self.static or turn.time > turns[-1].time:
            turns.append(turn)
        elif turn.time > turns[-1].time - CACHE_SECONDS:
            at = bisect.bisect_left([one.time for one in turns], turn.time)
            if turns[at].time == turn.time:
                turns[at] = turn
            else:
                ordered = [*turns]
                ordered.insert(at, turn)
                turns.clear()
                turns.extend(ordered)
        while turns[0].time < turns[-1].time - CACHE_SECONDS:
            turns.popleft()

    def is_long_after(self, time: float) -> bool:
        """Return whether the time has jumped back."""
        return not self.static and bool(self.turns) and self.turns[-1].time - time > CACHE_SECONDS

    def at(self, time: float) -> Quaternion | None:
        """Return the rotation at a time in s, interpolated; None outside of the known times."""
        turns = self.turns
        if self.static:
            return turns[-1].rotation if turns else None
        if not turns or not turns[0].time <= time <= turns[-1].time:
            return None
        later = turns[-1]
        for turn in reversed(turns):  # mostly one of the last is sought
            if turn.time <= time:
                part = (time - turn.time) / (later.time - turn.time) if later.time > turn.time else 0.0
                return _interpolated(turn.rotation, later.rotation, part)
            later = turn
        return None


class RotationBuffer:
    """The rotations between two coordinate frames, interpolated in time. Safe from any thread.

    Rotations that change are kept only for the two and those above them: a robot publishes hundreds of others.

    Parameters
    ----------
    world, head : str
        Names of the coordinate frames.
    report : callable
        Called with (line, kind) for transforms that are ignored.
    """

    def __init__(self, world: str, head: str, report: Callable[[str, str], object]) -> None:
        self._world, self._head, self._report = world, head, report
        self._lock = threading.Lock()
        self._frames: dict[str, CoordinateFrame] = {}
        self._relevant = {world, head}

    def clear(self) -> None:
        """Forget all rotations except the static ones."""
        with self._lock:
            self._clear()

    def _clear(self) -> None:
        for frame in self._frames.values():
            if not frame.static:
                frame.turns.clear()

    def add_message(self, message: Any, static: bool, seconds: Callable[[Any], float]) -> None:
        """Add the transforms of a message of /tf or, `static`, of /tf_static; `seconds` returns a stamp in s."""
        for one in message.transforms:
            shift, turn = one.transform.translation, one.transform.rotation
            time = seconds(one.header.stamp) if math.isfinite(shift.x + shift.y + shift.z) else math.nan
            self.add(one.child_frame_id, one.header.frame_id, time, (turn.x, turn.y, turn.z, turn.w), static)

    def add(self, child: str, parent: str, time: float, rotation: Quaternion, static: bool) -> None:
        """Add the rotation of `child` relative to `parent` at a clock time in s."""
        child, parent = child.lstrip("/"), parent.lstrip("/")
        if not _is_valid(child, parent, time, rotation):
            self._report(f"/tf: the transform of {printable(child)[:MAX_NAME]} is not valid and ignored", "invalid")
            return
        norm = math.hypot(*rotation)
        x, y, z, w = rotation
        with self._lock:
            frame = self._frames.get(child)
            if frame is None and len(self._frames) >= MAX_FRAMES:
                self._report(f"/tf: more than {MAX_FRAMES} coordinate frames; the others are ignored", "number")
                return
            if frame is None or frame.parent != parent or frame.static != static:
                frame = self._frames[child] = CoordinateFrame(parent, static)
                self._relevant = {*self._chain(self._world), *self._chain(self._head)}
            if not static and child not in self._relevant:
                return
            if frame.is_long_after(time):
                self._clear()
            frame.add(Turn(time, (x / norm, y / norm, z / norm, w / norm)))

    def rotation(self, moment: float) -> Quaternion | None:
        """Return the quaternion x, y, z, w of the head in the world at a clock time in s; None if it is not known."""
        with self._lock:
            head, world = self._chain(self._head), self._chain(self._world)
            common = next((name for name in head if name in world), None)
            if common is None:
                return None
            down = self._product(head[: head.index(common)], moment)
            up = self._product(world[: world.index(common)], moment)
        return None if down is None or up is None else _times(_inverse(up), down)

    def _chain(self, name: str) -> list[str]:
        """Return a coordinate frame and those above it."""
        chain = [name]
        while (frame := self._frames.get(chain[-1])) is not None and frame.parent not in chain:
            chain.append(frame.parent)
        return chain

    def _product(self, names: list[str], moment: float) -> Quaternion | None:
        """Return the rotation of the first of `names`, each of which is the parent of the one before."""
        product: Quaternion = (0.0, 0.0, 0.0, 1.0)
        for name in names:
            rotation = self._frames[name].at(moment)
            if rotation is None:
                return None
            product = _times(rotation, product)
        return product


def _is_valid(child: str, parent: str, time: float, rotation: Quaternion) -> bool:
    """Return whether tf2 accepts a transform."""
    named = child and parent and child != parent and max(len(child), len(parent)) <= MAX_NAME
    square = sum(part * part for part in rotation)  # ** raises OverflowError
    return bool(named) and abs(square - 1) < _NORM_TOLERANCE and math.isfinite(time)


def _inverse(rotation: Quaternion) -> Quaternion:
    x, y, z, w = rotation
    return -x, -y, -z, w


def _times(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _interpolated(a: Quaternion, b: Quaternion, part: float) -> Quaternion:
    """Return the rotation between two, on the shortest way, as tf2 does (Shoemake, SIGGRAPH 1985)."""
    cosine = sum(one * other for one, other in zip(a, b, strict=True))
    sign = -1.0 if cosine < 0 else 1.0
    cosine = abs(cosine)
    if cosine > _PARALLEL:
        weights = 1 - part, sign * part
    else:
        angle = math.acos(cosine)
        weights = math.sin((1 - part) * angle) / math.sin(angle), sign * math.sin(part * angle) / math.sin(angle)
    mixed = [weights[0] * one + weights[1] * other for one, other in zip(a, b, strict=True)]
    norm = math.sqrt(sum(value * value for value in mixed))
    x, y, z, w = (value / norm for value in mixed)
    return x, y, z, w
