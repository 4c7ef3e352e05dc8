"""Whether there is sound on a topic, and its sample rate."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import rospy

POLL_SECONDS = 0.05


async def sound_rate(topic: str, seconds: float) -> int:
    """Return the sample rate (Hz) of the sound on a topic (`binaudio_portStruct`); 0 if there is none within a time."""
    rates: list[int] = []  # of messages: the first one may be an old one of a latched topic

    def received(message: Any) -> None:
        rates.append(int.from_bytes(message._buff[:4], "little"))  # the message begins with it

    subscriber = rospy.Subscriber(topic, rospy.AnyMsg, received, queue_size=1)
    try:
        until = time.monotonic() + seconds
        while len(rates) < 2 and time.monotonic() < until:
            await asyncio.sleep(POLL_SECONDS)
    finally:
        subscriber.unregister()
    return rates[-1] if len(rates) > 1 else 0
