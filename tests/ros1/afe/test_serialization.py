"""The wire format: the same bytes as the generated classes, arrays instead of lists, clean errors for garbage."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import Any

import genpy
import numpy as np
import pytest
import rosAFE.msg
import rosAFE.srv
import rosbag
from hypothesis import given, settings
from hypothesis import strategies as st

import bass.msg
from rosafe import interface
from rosafe.ros import array_msg
from rosafe.ros1.component import serialization
from rosafe.ros1.transport.publisher import BufferList
from rosafe.tree.history import SlidingWindow

TIME_DOMAIN = "::rosAFE::TimeDomainSignalPortStruct"
TIME_FREQUENCY = "::rosAFE::TimeFrequencySignalPortStruct"
CROSS_CORRELATION = "::rosAFE::CrossCorrelationSignalPortStruct"
AUDIO = "::binaudio::portStruct"
LEVELS = {TIME_DOMAIN: 1, TIME_FREQUENCY: 2, CROSS_CORRELATION: 3}
HEADS: dict[str, dict[str, int]] = {
    TIME_DOMAIN: {"sampleRate": 44100, "lastFrameIndex": 2**40, "framesOnPort": 7},
    TIME_FREQUENCY: {"sampleRate": 100, "lastFrameIndex": 1, "framesOnPort": 7, "numberOfChannels": 31},
    CROSS_CORRELATION: {
        "sampleRate": 100,
        "lastFrameIndex": 0,
        "framesOnPort": 7,
        "numberOfLags": 99,
        "numberOfChannels": 31,
    },
}


def plain_class(idl: str) -> Any:
    return getattr(rosAFE.msg, interface.ros_type(idl))


def serialized(message: Any) -> bytes:
    out = io.BytesIO()
    message.serialize(out)
    return out.getvalue()


def _nested(values: Any, depth: int) -> Any:
    """Return nested lists in the form of the generated classes."""
    if depth == 1:
        return rosAFE.msg.rosAFE_signalOneD(data=values)
    if depth == 2:
        return rosAFE.msg.rosAFE_signalND(dataN=[_nested(v, 1) for v in values])
    return rosAFE.msg.rosAFE_signalNxND(dataNxN=[_nested(v, 2) for v in values])


def ours_and_plain(idl: str, left: np.ndarray, right: np.ndarray | None = None) -> tuple[Any, Any]:
    """Return the same message in our class and in the generated one."""
    signals = {"left": left} if idl == CROSS_CORRELATION else {"left": left, "right": left if right is None else right}
    lists = {name: _nested(array.tolist(), LEVELS[idl]) for name, array in signals.items()}
    return (
        serialization.message_class("rosAFE", idl)(**HEADS[idl], **signals),
        plain_class(idl)(**HEADS[idl], **lists),
    )


@settings(max_examples=80)
@given(data=st.data(), idl=st.sampled_from(sorted(LEVELS)))
def test_bytes_are_those_of_the_generated_class(data: st.DataObject, idl: str) -> None:
    shape = data.draw(st.tuples(*[st.integers(1, 5)] * (LEVELS[idl] - 1), st.integers(0, 6)))
    values = np.random.default_rng(data.draw(st.integers(0, 99))).normal(size=shape)
    ours, plain = ours_and_plain(idl, values, 2 * values)
    sent = serialized(plain)
    assert serialized(ours) == sent
    back = serialization.message_class("rosAFE", idl)().deserialize(sent)
    np.testing.assert_array_equal(back.left, values)
    assert back.left.shape == shape
    assert {name: getattr(back, name) for name in HEADS[idl]} == HEADS[idl]
    assert serialized(plain_class(idl)().deserialize(serialized(ours))) == sent
    assert serialized(back) == sent, "a received message can be sent again"


@pytest.mark.parametrize("idl", sorted(LEVELS))
def test_types_are_those_of_the_generated_class(idl: str) -> None:
    ours, plain = serialization.message_class("rosAFE", idl), plain_class(idl)
    assert (ours._md5sum, ours._type, ours._full_text) == (plain._md5sum, plain._type, plain._full_text)
    assert issubclass(ours, plain)
    assert serialization.message_class("rosAFE", idl) is ours


@pytest.mark.parametrize("idl", sorted(LEVELS))
def test_a_message_created_without_arrays_can_be_sent(idl: str) -> None:
    assert serialized(serialization.message_class("rosAFE", idl)()) == serialized(plain_class(idl)())


@pytest.mark.parametrize("idl", sorted(LEVELS))
def test_empty_and_long_signals(idl: str) -> None:
    """A received message with an absent signal can be sent again."""
    default = serialized(plain_class(idl)())
    assert serialized(serialization.message_class("rosAFE", idl)().deserialize(default)) == default
    long = {1: (20_000,), 2: (3000, 5), 3: (30, 100, 5)}[LEVELS[idl]]
    for shape in [*itertools.product((0, 1, 3), repeat=LEVELS[idl]), long]:
        if shape[:1] == (0,) and LEVELS[idl] > 1:
            continue  # absent
        ours, plain = ours_and_plain(idl, np.random.default_rng(1).normal(size=shape))
        assert serialized(ours) == serialized(plain), shape


@pytest.mark.parametrize(
    "fields", [{"left": np.ones((2, 3))}, {**HEADS[TIME_FREQUENCY], "left": np.ones((2, 3)), "right": None}]
)
def test_missing_fields_get_the_defaults_of_the_generated_class(fields: dict[str, Any]) -> None:
    message_class = serialization.message_class("rosAFE", TIME_FREQUENCY)
    received = message_class().deserialize(serialized(message_class(**fields)))
    assert received.right.shape == (0, 0) and received.sampleRate == fields.get("sampleRate", 0)
    with pytest.raises(AttributeError, match="sampelRate"):
        message_class(sampelRate=1, lastFrameIndex=1, framesOnPort=1, numberOfChannels=1, left=[], right=[])


@settings(max_examples=60)
@given(
    idl=st.sampled_from(sorted(LEVELS)),
    blocks=st.lists(st.integers(1, 40), max_size=6),
    frames=st.integers(1, 60),
    row_bytes=st.sampled_from([1, 100, 10**9]),
)
def test_contiguous_and_copied_rows(idl: str, blocks: list[int], frames: int, row_bytes: int) -> None:
    """The bytes of a window do not depend on the way of writing it: into memory or gathered, with zeros or blocks."""
    rows = (2, 3)[: LEVELS[idl] - 1] if idl == CROSS_CORRELATION else (2, 3)[: LEVELS[idl]]
    window = SlidingWindow(rows, frames)
    for size in blocks:
        window.append(np.random.default_rng(size).normal(size=(*rows, size)))
    view = window.padded_view(frames)
    if idl == CROSS_CORRELATION:
        ours, plain = ours_and_plain(idl, view.array().swapaxes(0, 1))
        ours.left = view.swap_rows()
    else:
        ours, plain = ours_and_plain(idl, *view.array())
        ours.left, ours.right = view.select(0), view.select(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serialization, "ROW_BYTES", row_bytes)
        buffers = BufferList()
        ours.serialize(buffers)
        assert serialized(ours) == serialized(plain)
    assert b"".join(buffers.pieces) == serialized(plain)
    assert buffers.size == len(serialized(plain))


def test_array_msg_is_the_class_of_a_generated_one() -> None:
    for package, classes in (("rosAFE", rosAFE.msg), ("bass", bass.msg)):
        for idl in interface.COMPONENTS[package].structs:
            generated = getattr(classes, interface.ros_type(idl))
            assert array_msg(generated) is serialization.message_class(package, idl)
            assert array_msg(array_msg(generated)) is array_msg(generated)
    for wrong in (None, int, "rosAFE/rosAFE_signalND", rosAFE.msg.InputProcGoal, genpy.Message):
        with pytest.raises(TypeError, match="expected a message class"):
            array_msg(wrong)


def test_another_build_of_a_class_is_rejected() -> None:
    other = type("binaudio_portStruct", (bass.msg.binaudio_portStruct,), {"_md5sum": "0" * 32})
    with pytest.raises(TypeError):
        array_msg(other)


def test_bags_can_store_such_messages(tmp_path: Path) -> None:
    ours, plain = ours_and_plain(TIME_FREQUENCY, np.arange(12.0).reshape(3, 4))
    with rosbag.Bag(str(tmp_path / "a.bag"), "w") as bag:
        bag.write("/ours", ours)
        bag.write("/plain", plain)
    with rosbag.Bag(str(tmp_path / "a.bag")) as bag:
        for _, (name, data, md5, _, _), _ in bag.read_messages(raw=True):
            assert (name, md5) == (plain._type, plain._md5sum)
            read = array_msg(type(plain))().deserialize(data)
            np.testing.assert_array_equal(read.left, ours.left)
        assert [m.left.dataN[2].data[3] for _, m, _ in bag.read_messages()] == [11.0, 11.0]


def test_ragged_signals_are_lists_of_arrays() -> None:
    plain = plain_class(TIME_FREQUENCY)(
        left=_nested([[1.0, 2.0], [3.0]], 2), right=_nested([[], [1.0]], 2), **HEADS[TIME_FREQUENCY]
    )
    received = serialization.message_class("rosAFE", TIME_FREQUENCY)().deserialize(serialized(plain))
    assert [row.tolist() for row in received.left] == [[1.0, 2.0], [3.0]]
    assert [row.tolist() for row in received.right] == [[], [1.0]]


def test_audio_is_int32_and_its_stamp_a_struct() -> None:
    left = np.array([-(2**31), -1, 0, 2**31 - 1], np.int32)
    plain = bass.msg.binaudio_portStruct(
        sampleRate=44100,
        nChunksOnPort=2,
        nFramesPerChunk=2,
        lastFrameIndex=2**40,
        left=left.tolist(),
        right=left[::-1].tolist(),
        stamp=bass.msg.binaudio_timestamp(sec=3, nsec=4),
    )
    ours = serialization.message_class("bass", AUDIO)(
        sampleRate=44100,
        nChunksOnPort=2,
        nFramesPerChunk=2,
        lastFrameIndex=2**40,
        left=left,
        right=left[::-1],
        stamp={"sec": 3, "nsec": 4},
    )
    assert serialized(ours) == serialized(plain)
    received = serialization.message_class("rosAFE", AUDIO)().deserialize(serialized(plain))
    assert received.left.dtype == np.int32 and received.left.tolist() == left.tolist()
    assert not received.left.flags.writeable
    assert (received.stamp.sec, received.stamp["nsec"]) == (3, 4)
    with pytest.raises(AttributeError):
        _ = received.stamp.minutes
    assert serialized(received) == serialized(plain)


# --- unreadable messages ----------------------------------------------------------------------------------------


def audio_bytes() -> bytes:
    return serialized(bass.msg.binaudio_portStruct(sampleRate=8, left=[1, 2, 3], right=[4, 5, 6]))


@pytest.mark.parametrize("idl", [*sorted(LEVELS), AUDIO])
def test_messages_truncated_anywhere_are_rejected(idl: str) -> None:
    whole = audio_bytes() if idl == AUDIO else serialized(ours_and_plain(idl, np.ones((2, 3, 4)[3 - LEVELS[idl] :]))[1])
    for length in range(len(whole)):
        with pytest.raises(genpy.DeserializationError):
            serialization.message_class("rosAFE", idl)().deserialize(whole[:length])


@settings(max_examples=200)
@given(idl=st.sampled_from([*sorted(LEVELS), AUDIO]), data=st.binary(max_size=120))
def test_garbage_is_rejected_or_read(idl: str, data: bytes) -> None:
    lenient = serialization.tolerant_message_class("rosAFE", idl, 100)().deserialize(data)
    try:
        serialization.message_class("rosAFE", idl)().deserialize(data)
    except genpy.DeserializationError as problem:
        assert lenient.problem == str(problem) != ""
    else:
        assert lenient.problem == ""


def test_a_signal_that_numpy_cannot_reshape_is_read() -> None:
    """More than 2 GB in one piece, of zeros that are never accessed and therefore need no memory."""
    head = serialized(plain_class(TIME_DOMAIN)())[:20]
    count = 2**28 + 1
    data = np.zeros(len(head) + 4 + 8 * count + 4, np.uint8)
    data[: len(head)] = np.frombuffer(head, np.uint8)
    data[len(head) : len(head) + 4] = np.frombuffer(count.to_bytes(4, "little"), np.uint8)
    message = serialization.message_class("rosAFE", TIME_DOMAIN)().deserialize(data)
    assert (message.left.shape, message.right.shape) == ((count,), (0,))
    assert message.left[0] == message.left[-1] == 0.0


@pytest.mark.parametrize("idl", sorted(LEVELS))
def test_counts_beyond_the_message_need_no_memory(idl: str) -> None:
    message_class = serialization.message_class("rosAFE", idl)
    head = serialized(plain_class(idl)())[: {TIME_DOMAIN: 20, TIME_FREQUENCY: 24, CROSS_CORRELATION: 32}[idl]]
    huge = (2**32 - 1).to_bytes(4, "little")
    for counts in range(1, 4):
        with pytest.raises(genpy.DeserializationError, match="message ends at"):
            message_class().deserialize(head + huge * counts)
    with pytest.raises(genpy.DeserializationError):
        message_class().deserialize(head + huge + bytes(1000))


# --- unwritable messages -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sampleRate", -1),
        ("sampleRate", 2**32),
        ("sampleRate", "44100"),
        ("lastFrameIndex", 1.5),
        ("left", np.ones((2, 2), np.int32)),
        ("left", [1.5]),
        ("left", [2**31]),
        ("left", ["a"]),
        ("left", 3),
        ("stamp", {"sec": 1}),
        ("stamp", 5),
    ],
)
def test_values_that_do_not_fit_are_rejected_by_name(field: str, value: Any) -> None:
    message = serialization.message_class("bass", AUDIO)(**{field: value})
    with pytest.raises(genpy.SerializationError, match=field):
        serialized(message)


def test_signals_of_the_wrong_shape_are_rejected() -> None:
    for idl, levels in LEVELS.items():
        for shape in {1: (2, 2), 2: (3,), 3: (2, 2)}[levels], (1, 1, 1, 1):
            with pytest.raises(genpy.SerializationError, match="left"):
                serialized(serialization.message_class("rosAFE", idl)(left=np.ones(shape)))
    with pytest.raises(genpy.SerializationError, match="left"):
        serialized(serialization.message_class("rosAFE", TIME_FREQUENCY)(left=[[1.0, 2.0], [3.0]]))


# --- large messages ---------------------------------------------------------------------------------------------
