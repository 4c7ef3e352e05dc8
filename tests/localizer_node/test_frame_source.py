"""Messages of a port of the localizer: those of an earlier stream are dropped."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest
import rospy

from rosafe.localizer_node import frame_source
from rosafe.localizer_node.frame_source import FrameFormat


def test_messages_of_an_earlier_stream_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    receive: list[Any] = []
    monkeypatch.setattr(rospy, "Subscriber", lambda topic, kind, callback, **_: receive.append(callback))
    source: Any = SimpleNamespace(lock=threading.Lock(), is_ready=lambda: False)
    port = frame_source._Port("/rosAFE/ildPort/ild", "ild", FrameFormat(16000, 4, 320, 160, 1000), source)

    def send(index: int) -> None:
        receive[0](SimpleNamespace(data=frame_source._HEAD.pack(0, index, 10)))

    for index in (1000, 2000, 3000):
        send(index)
    assert [*port.messages] == [1000, 2000, 3000]
    send(500)  # the sound has begun again
    send(1500)
    assert [*port.messages] == [500, 1500]
