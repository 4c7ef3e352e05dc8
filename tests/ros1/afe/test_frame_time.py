"""Times of frames: the fitted line is more exact than the stamps; clients that use it."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import rospy
from hypothesis import example, given
from hypothesis import strategies as st
from rosAFE.msg import rosAFE_frameTime, rosAFE_TimeFrequencySignalPortStruct

from rosafe.audio.stream.frame_clock import FrameTime
from rosafe.ros import FrameClock, array_msg
from tests.harness import Graph, wait_for
from tests.ros1.afe.session import Microphone, Session, noise

BEGIN = 1_700_000_000.0


def delays(kind: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Return delays of stamps (s)."""
    late = random.exponential(0.002, count)
    if kind == "spikes":
        late[random.random(count) < 0.1] += 0.04
    if kind == "bursts":  # a machine that is busy for seconds
        late += 0.015 * (np.sin(np.arange(count) / 60) > 0.7)
    return late if kind != "none" else np.zeros(count)


@pytest.mark.parametrize(
    ("kind", "skew", "chunk", "per_block"),
    [
        ("none", 0.0, 2205, 5),
        ("none", 80e-6, 441, 2),  # each stamp is the earliest of its bin
        ("plain", 80e-6, 2205, 5),
        ("spikes", -80e-6, 2205, 5),
        ("bursts", 80e-6, 2205, 1),
        ("spikes", 80e-6, 441, 2),
    ],
)
def test_delays_of_stamps_do_not_affect_the_line(kind: str, skew: float, chunk: int, per_block: int) -> None:
    random = np.random.default_rng(3)
    rate = 44100 * (1 + skew)
    times = FrameTime()
    times.begin(44100)
    count = 150 * 44100 // chunk
    estimated, true, line = [], [], None
    for k, late in enumerate(delays(kind, count, random), 1):
        times.add(k * chunk, BEGIN + k * chunk / rate + late)
        if k % per_block == 0:
            line = times.line(k * chunk)
            assert line is not None
            estimated.append(line.time - BEGIN)
            true.append(k * chunk / rate)
    errors = np.array(estimated) - true
    seconds = np.array(true)
    assert (np.diff(estimated) > 0).all()
    steps = np.diff(errors)[seconds[1:] > 2]
    assert np.abs(steps).max() < 2e-4, "between two results"
    assert np.abs(errors[seconds > 30]).max() < 2e-4, "deviation from the true time"
    assert line is not None
    assert abs(line.rate / rate - 1) < 5e-6


@pytest.mark.parametrize("seconds", [2, 20])  # the rate is not fitted yet, and is fitted
def test_the_line_is_never_later_than_a_stamp(seconds: int) -> None:
    """An earlier stamp lowers it at once, also within the same bin."""
    times = FrameTime()
    times.begin(1000)
    frames = range(100, seconds * 1000, 100)  # 2 or 3 in each bin
    for frame in frames:
        times.add(frame, BEGIN + frame / 1000 + 0.02)
    for step in range(1, 6):
        times.add(frames[-1] + step, BEGIN + (frames[-1] + step) / 1000 + 0.02 - 0.003 * step)
        assert times._fit().at(frames[-1] + step) < BEGIN + (frames[-1] + step) / 1000 + 0.0201 - 0.003 * step


@pytest.mark.parametrize("speed", [0.0, 0.5, 0.99])
def test_a_clock_that_is_slower_than_the_sound(speed: float) -> None:
    """The clock of a simulation. The rate of the line can hardly change, so the fit restarts."""
    times = FrameTime()
    times.begin(16000)
    for frame in range(800, 20 * 16000, 800):
        clock = BEGIN + speed * frame / 16000
        times.add(frame, clock)
        line = times.line(frame)
        assert line is not None and abs(line.time - clock) < 0.052


def test_a_clock_that_is_set_and_a_restarted_stream() -> None:
    times = FrameTime()
    times.begin(1000)
    for step in (0.0, -3.0, 7.0):
        first = times._points[-1][0] + 100 if times._points else 100
        for frame in range(first, first + 20_000, 100):
            times.add(frame, BEGIN + frame / 1000 + step)
        line = times.line(frame)
        assert line is not None
        assert line.time == pytest.approx(BEGIN + frame / 1000 + step, abs=1e-6)
    times.begin(2000)
    assert times.line(5) is None
    times.add(5, BEGIN)
    line = times.line(5)
    assert line is not None
    assert (line.time, line.rate) == (BEGIN, 2000)


@given(
    steps=st.lists(st.sampled_from([1, 40, 500, 100_000, 2**30, 2**62]), min_size=2, max_size=60),
    late=st.lists(st.floats(0, 30), min_size=1, max_size=5),
)
@example(steps=[500, 2**62, 40, 1], late=[0.0])
def test_any_index_has_a_time(steps: list[int], late: list[float]) -> None:
    """For any sequence of indices, up to the maximum in a message."""
    times, frame = FrameTime(), 0
    times.begin(8)
    for k, step in enumerate(steps):
        if (frame := frame + step) >= 2**63:
            break
        times.add(frame, BEGIN + k + late[k % len(late)])
        line = times.line(frame)
        assert line is not None
        assert np.isfinite(line.time) and line.rate == pytest.approx(8, rel=0.01)


class Stamped(Microphone):
    """A microphone with exact stamps."""

    def stamp(self) -> dict[str, int]:
        if self.index == 0:
            return super().stamp()
        seconds, nanoseconds = divmod(self.nanoseconds(self.index), 1_000_000_000)
        return {"sec": seconds, "nsec": nanoseconds}

    def nanoseconds(self, index: float) -> int:
        """Return when a frame was captured."""
        return int(1.7e18) + round(index * 1e9 / self.sample_rate)


@pytest.fixture
def stamped(afe: Session) -> Iterator[Stamped]:
    microphone = Stamped(afe.graph)
    afe.microphone = microphone
    afe.ok("connect_port", local="Audio", remote=microphone.topic)
    yield microphone


def test_a_time_is_published_with_each_block(afe: Session, stamped: Stamped) -> None:
    afe.build("PreProc", block=1000)
    with afe.graph.collect("/rosAFE/frameTime", rosAFE_frameTime) as messages:
        wait_for(lambda: afe.connections("/rosAFE/frameTime"), what="the connection")
        stamped.play(noise(10_000))
        wait_for(lambda: messages and messages[-1].frameIndex == 10_000, what=lambda: str(messages))
        afe.read("preProc", 10_001)
    assert [m.frameIndex for m in messages] == [*range(1000, 11_000, 1000)]
    for message in messages:
        assert abs(message.stamp.to_nsec() - stamped.nanoseconds(message.frameIndex)) < 2000
        assert message.sampleRate == pytest.approx(20_000)


def test_a_client_computes_the_time_of_a_frame_of_any_port(afe: Session, stamped: Stamped) -> None:
    with contextlib.closing(FrameClock("/absent")) as clock:
        with pytest.raises(LookupError, match="/absent/frameTime"):
            clock.time(3)
        with pytest.raises(ValueError, match="timeout: expected seconds or None, got nan"):
            clock.wait(float("nan"))
        assert not clock.wait(0.0)
    clock = FrameClock()
    afe.build("PreProc", "GammatoneProc", "IhcProc", "IldProc", block=1600)  # hop of 200 frames, window of 400
    stamped.play(noise(8000))
    assert clock.wait()
    ild = afe.graph.message(
        "/rosAFE/ildPort/ild", array_msg(rosAFE_TimeFrequencySignalPortStruct), lambda m: m.lastFrameIndex == 8001
    )
    wait_for(lambda: abs(clock.time(8000).wall - 1.7e9 - 0.4) < 1e-5, what="the newest line")
    sound = SimpleNamespace(lastFrameIndex=8001, framesOnPort=20_000)
    for frame, index in ((-1, 8000), (-20, 7981), (19_999, 8000)):
        assert clock.of(sound, frame).wall == pytest.approx(1.7e9 + index / 20_000, abs=1e-5)
    for frame, middle in ((-1, 7800), (-3, 7400)):  # the newest frame covers 7601 to 8000
        moment = clock.of(ild, frame, window=0.02, hop=0.01)
        assert moment.wall == pytest.approx(1.7e9 + (middle + 1) / 20_000, abs=6e-5)
        wall_now = rospy.get_time()
        assert abs(moment.ros.to_sec() - moment.wall) < abs(wall_now - moment.wall)
    with pytest.raises(LookupError, match="frame: expected"):
        clock.of(ild, 100_000)
    clock.close()


@pytest.mark.parametrize("clock_first", [True, False])
def test_a_clock_and_a_subscriber_in_one_process(afe: Session, stamped: Stamped, clock_first: bool) -> None:
    """rospy uses the message class of the first one for both."""
    clock = FrameClock() if clock_first else None
    afe.build(block=1000)
    with afe.graph.collect("/rosAFE/frameTime", rosAFE_frameTime) as messages:
        clock = clock or FrameClock()
        stamped.play(noise(3000))
        wait_for(lambda: messages and messages[-1].frameIndex == 3000, what="the subscriber")
        assert clock.wait()
        wait_for(lambda: abs(clock.time(3000).wall - messages[-1].stamp.to_sec()) < 1e-5, what="the clock")
    assert clock.problem == ""
    clock.close()


@pytest.fixture
def published(graph: Graph) -> Iterator[tuple[FrameClock, Callable[..., None]]]:
    """Return a clock, and a function that publishes a time of a frame for it."""
    graph.client()
    clock = FrameClock("/other")
    publisher = rospy.Publisher("/other/frameTime", rosAFE_frameTime, queue_size=10)
    wait_for(lambda: publisher.get_num_connections())

    def publish(frame: int, rate: float, seconds: float = 1.7e9) -> None:
        publisher.publish(stamp=rospy.Time.from_sec(seconds), frameIndex=frame, sampleRate=rate)

    yield clock, publish
    clock.close()
    publisher.unregister()


def test_a_thread_that_waits_between_two_clocks(published: tuple[FrameClock, Callable[..., None]]) -> None:
    """ROS time is that of the system, also if the thread waits between the readings of both clocks."""
    clock, publish = published
    waits = iter((0.02, 0.02))

    def get_time() -> float:
        time.sleep(next(waits, 0.0))
        return rospy.get_time()

    clock._rospy = SimpleNamespace(get_time=get_time, Time=rospy.Time)
    now = time.time()
    publish(1000, 44100.0, now)
    wait_for(lambda: clock.covers(1000, 1))
    assert clock.time(1000).ros.to_sec() == pytest.approx(now, abs=1e-3, rel=0)


def test_a_sound_card_that_runs_slightly_fast(published: tuple[FrameClock, Callable[..., None]]) -> None:
    """The lengths of frames are those of the nominal sample rate."""
    clock, publish = published
    rate = 44100 * (1 + 4e-4)
    publish(441_000, rate)
    publish(445_410, rate, 1.7e9 + 4410 / rate)  # the hop of 441 frames divides the block
    wait_for(lambda: len(clock._lines) == 2)
    frame = SimpleNamespace(lastFrameIndex=445_411, framesOnPort=10)
    for window, samples, left_over in ((0.5, 22_050, 0), (0.03, 1324, 440), (0.02, 882, 0)):
        middle = clock.of(frame, window=window, hop=0.01).wall
        expected = 445_411 - left_over - samples / 2
        assert middle - clock.time(expected).wall == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("rate", "seconds", "problem"),
    [
        *((rate, 1.7e9, "sampleRate: expected a number from 1 to") for rate in (0.0, -1.0, 1e300, math.inf, math.nan)),
        (44100.0, 2.0**32 - 10, "stamp: expected a time below"),
    ],
)
def test_times_that_are_not_valid(
    published: tuple[FrameClock, Callable[..., None]], rate: float, seconds: float, problem: str
) -> None:
    clock, publish = published
    publish(1000, rate, seconds)
    wait_for(lambda: clock.problem)
    assert clock.problem.startswith(f"/other/frameTime: {problem}")
    assert not clock.covers(1000, 1e9)
    publish(1000, 44100.0)
    wait_for(lambda: clock.covers(1000, 1))
    assert not clock.problem
