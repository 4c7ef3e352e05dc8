"""Headers of sound files, compared with the files: sound that a decoder would leave out without an error.

References: RIFF (Microsoft 1991), RF64 (EBU Tech 3306), Sony Wave64, AIFF-C (Apple 1991), Core Audio Format (Apple
2006), Sun AU, NIST SPHERE, FLAC (RFC 9639), Ogg (RFC 3533).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from io import BufferedReader
from typing import NamedTuple

CONVERT = "convert it: `ffmpeg -i IN OUT.wav`"
_NEAR = 2**14  # a program that writes to a pipe states a size that differs from 2^31 or 2^32 by less
_SOX_AIFF = 0x7F000008  # the size that SoX states for a pipe
_LONG = "expected a header that counts at most 4 GiB, got {} bytes; convert it: `ffmpeg -ignore_length 1 -i IN OUT.w64`"
TAGS = (b"TAG", b"APETAGEX", b"LYRICSBEGIN")  # that can follow the sound
_MAX_CHUNKS = 10_000
_CHECKED_TAIL = 2**16  # bytes
_W64_GUID = bytes.fromhex("f3acd3118cd100c04f8edb8a")
_OGG_SOUND = (b"\x01vorbis", b"OpusHead", b"\x7fFLAC", b"Speex   ")
# offset, bytes, kind: formats that libsndfile does not read
_FOREIGN = (
    (4, b"ftyp", "MPEG-4 (m4a, mp4, mov)"),
    (4, b"moov", "QuickTime"),
    (4, b"mdat", "QuickTime"),
    (4, b"wide", "QuickTime"),
    (0, b"\x1a\x45\xdf\xa3", "Matroska or WebM"),
    (0, b"BW64", "BW64"),
    (8, b"AVI ", "AVI"),
    (0, b"#!AMR", "AMR"),
    (0, bytes.fromhex("3026b2758e66cf11"), "Windows Media (WMA, WMV)"),
    (0, b"FLV\x01", "Flash Video"),
    (0, b"wvpk", "WavPack"),
    (0, b"TTA", "True Audio"),
    (0, b"MAC ", "Monkey's Audio"),
    (0, b"MPCK", "Musepack"),
    (0, b"MP+", "Musepack"),
    (0, b"DSD ", "DSF"),
    (0, b"FRM8", "DSDIFF"),
    (0, b".RMF", "RealMedia"),
    (0, b".ra\xfd", "RealAudio"),
    (0, b"ajkg", "Shorten"),
    (0, b"ADIF", "AAC"),
    (0, b"\x0b\x77", "AC-3"),
    (0, b"\x7f\xfe\x80\x01", "DTS"),
    (0, b"\x00\x00\x01\xba", "MPEG video"),
    (188, b"\x47", "MPEG transport stream"),
    (28, b"Speex   ", "Ogg Speex"),
    (28, b"\x7fFLAC", "Ogg FLAC"),
)


class Header(NamedTuple):
    """Properties of a file that its decoder does not return."""

    remark: str = ""  # one line about bytes that are not read, or ''
    size: int = 0  # bytes of sound; 0 if unknown
    offset: int = 0  # that of `patch`
    patch: bytes = b""  # with these bytes the decoder reads the file to its end
    frames: int = 0  # stated by the header of FLAC; 0 if unknown
    exact: bool = False  # whether an MP3 states its number of frames; otherwise libsndfile estimates it
    least: float = 0.0  # s: length by the times of the pages of Ogg


def kind_of(begin: bytes) -> str:
    """Return the kind of a file, by its first bytes, that libsndfile does not read; '' if it is not known."""
    if begin[:1] == b"\xff" and len(begin) > 1 and begin[1] & 0xF6 == 0xF0:  # MPEG sync with layer 0
        return "AAC"
    for offset, magic, kind in _FOREIGN:
        if begin.startswith(magic, offset) and (kind != "MPEG transport stream" or begin[:1] == magic):
            return kind
    return ""


def read_header(file: BufferedReader, size: int) -> Header:
    """Compare the header of a sound file of `size` bytes with the file.

    Raises
    ------
    ValueError
        The file is cut, or has sound that libsndfile does not read.
    """
    begin = _bytes(file, 0, 64)
    if (magic := begin[:4]) in _LAYOUTS and (magic not in _KINDS or begin[8:12] in _KINDS[magic]):
        return _Chunks(file, size, _LAYOUTS[magic]).header()
    if begin[:4] in (b".snd", b"dns."):
        return _au(file, size)
    if begin.startswith(b"NIST_1A"):
        return _nist(file, size)
    if begin.startswith(b"OggS"):
        return _ogg(file, size)
    at = _after_id3(file)
    if (info := _bytes(file, at, 26)).startswith(b"fLaC"):
        known = bytes([info[21] & 0x0F]) + info[22:26]
        return Header(offset=at + 21, patch=bytes([info[21] & 0xF0, 0, 0, 0, 0]), frames=int.from_bytes(known, "big"))
    return Header(exact=re.search(b"Xing|Info", _bytes(file, at, 4096)) is not None)


def _bytes(file: BufferedReader, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count) or b""


def _after_id3(file: BufferedReader) -> int:
    """Return the offset of the first byte after the tags of ID3v2."""
    at = 0
    while (head := _bytes(file, at, 10)).startswith(b"ID3") and len(head) == 10:
        length = 0
        for byte in head[6:]:
            length = length << 7 | byte & 0x7F
        at += 10 + length + (10 if head[5] & 0x10 else 0)
    return at


def _check_size(stated: int, available: int) -> None:
    if stated > available:
        raise ValueError(f"expected {stated} bytes of sound, got {available}; the file is truncated")


def unread(count: int) -> str:
    """Return the remark about bytes behind the sound."""
    return f"{count} bytes behind the end of the sound are of no known kind and are not read"


def _tail(file: BufferedReader, at: int, size: int) -> str:
    """Return a remark about the bytes from `at` on, unless these are zeros or a tag."""
    begin = _bytes(file, at, _CHECKED_TAIL)
    return unread(size - at) if begin.strip(b"\0") and not begin.startswith(TAGS) else ""


# --- chunks -----------------------------------------------------------------------------------------------------


class _Layout(NamedTuple):
    """How a format stores its chunks."""

    start: int  # offset of the first chunk
    head: int  # bytes before the content of a chunk
    size: str  # of the size, for `struct`; it is the last field of the head
    data: bytes  # name of the chunk with the samples
    extra: int = 0  # bytes before the samples in this chunk
    align: int = 2


_LAYOUTS = {
    b"RIFF": _Layout(12, 8, "<I", b"data"),
    b"RF64": _Layout(12, 8, "<I", b"data"),
    b"RIFX": _Layout(12, 8, ">I", b"data"),
    b"FORM": _Layout(12, 8, ">I", b"SSND", 8),
    b"riff": _Layout(40, 24, "<Q", b"data", align=8),
    b"caff": _Layout(8, 12, ">Q", b"data", 4, align=1),
}
_KINDS = {  # bytes 8 to 11
    **dict.fromkeys((b"RIFF", b"RF64", b"RIFX"), (b"WAVE",)),
    b"FORM": (b"AIFF", b"AIFC"),
}


class _Chunks:
    """The chunks of a file."""

    def __init__(self, file: BufferedReader, size: int, layout: _Layout) -> None:
        self._file, self._size, self._layout = file, size, layout
        self._long: tuple[int, int] | None = None  # of RF64: size of the data, and its offset

    def _at(self, at: int) -> tuple[bytes, int] | None:
        """Return the name and the size of the content of a chunk; None if these bytes are none."""
        layout = self._layout
        head = _bytes(self._file, at, layout.head)
        if len(head) < layout.head:
            return None
        (length,) = struct.unpack(layout.size, head[-struct.calcsize(layout.size) :])
        if layout.align == 8:
            if head[4:16] != _W64_GUID or length < layout.head:
                return None
            length -= layout.head
        name = head[:4]
        if name == b"data" and length == 2**32 - 1 and self._long is not None:
            length = self._long[0]
        fits = at + layout.head + length <= self._size + layout.align
        return (name, length) if re.fullmatch(rb"[ -~\xa9]{4}", name) and (fits or name == layout.data) else None

    def header(self) -> Header:
        layout, at, pad = self._layout, self._layout.start, 0
        data: tuple[int, int] | None = None  # offset and size of the content
        count = 0
        while chunk := self._at(at):
            name, length = chunk
            count += 1
            if count > _MAX_CHUNKS:
                raise ValueError(f"expected at most {_MAX_CHUNKS} chunks, got more; the file is damaged")
            at += layout.head
            if name == b"ds64":
                self._long = struct.unpack("<Q", _bytes(self._file, at + 8, 8).ljust(8, b"\0"))[0], at + 8
            if name == layout.data:
                if data:
                    raise ValueError(f"expected one chunk of sound, got several; {CONVERT}")
                data = at, length
                if self._unknown(at, length):
                    return self._to_the_end(at)
                _check_size(length, self._size - at)
            pad = -length % layout.align
            at += length + pad
            if pad and self._at(at) is None and self._at(at - pad):
                at -= pad  # some programs omit it
        if data is None:
            raise ValueError("expected a chunk of sound, got none; the file is truncated or damaged")
        if data[1] <= layout.extra and at == data[0] + data[1] + pad and self._size > at:
            return self._to_the_end(data[0])
        return Header(self._rest(at), size=data[1] - layout.extra)

    def _unknown(self, at: int, length: int) -> bool:
        """Return whether the size of the data is a placeholder."""
        long = self._layout.size[1] == "Q" or self._long is not None
        if length <= self._size - at:
            return length == 2**32 - 1 and not long
        near = length > 2**30 and (length + _NEAR) % 2**31 < 2 * _NEAR
        return length >= 2**62 if long else near or length == _SOX_AIFF

    def _to_the_end(self, at: int) -> Header:
        """Return a header whose data reach to the end of the file."""
        if _bytes(self._file, at + self._layout.extra, 4) == _bytes(self._file, 0, 4):
            raise ValueError("expected sound, got a second header; the file is damaged")
        length = self._size - at
        if self._long is not None:
            return Header(offset=self._long[1], patch=struct.pack("<Q", length))
        if self._layout.size[1] == "I" and length >= 2**32:
            raise ValueError(_LONG.format(self._size))
        if self._layout.align == 8:
            length += self._layout.head
        patch = struct.pack(self._layout.size, length)
        return Header(offset=at - len(patch), patch=patch)

    def _rest(self, at: int) -> str:
        """Return a remark about the bytes from `at` on, which are not chunks."""
        if self._layout.size[1] == "I" and self._size - at >= 2**32:
            raise ValueError(_LONG.format(self._size))  # the size is only the remainder
        return _tail(self._file, at, self._size)


# --- other formats ----------------------------------------------------------------------------------------------


def _au(file: BufferedReader, size: int) -> Header:
    order = ">" if _bytes(file, 0, 4) == b".snd" else "<"
    fields = _bytes(file, 4, 20)
    if len(fields) < 20:
        return Header()
    first, length = struct.unpack(f"{order}2I", fields[:8])
    available = size - first
    if length == 0 and available > 0:
        return Header(offset=8, patch=b"\xff" * 4)
    if length == 2**32 - 1:
        return Header()
    if available - length >= 2**32:
        raise ValueError(_LONG.format(size))
    _check_size(length, available)
    return Header(_tail(file, first + length, size), length)


def _nist(file: BufferedReader, size: int) -> Header:
    text = _bytes(file, 0, 1024)
    found = [
        re.search(name + rb" -i (\d{1,18})\s", text) for name in (b"sample_count", b"channel_count", b"sample_n_bytes")
    ]
    head = re.match(rb"NIST_1A\n *(\d{1,9})\n", text)
    if head is None or not all(found):
        return Header()
    stated = 1
    for field in found:
        stated *= int(field[1]) if field else 0
    available = size - int(head[1])
    _check_size(stated, available)
    return Header(_tail(file, int(head[1]) + stated, size) if stated else "", stated)


class _Page(NamedTuple):
    """A page of Ogg."""

    flags: int  # 2 at the first page of a stream, 4 at its last one
    time: int  # frames up to its end
    serial: int  # of its stream
    number: int  # in its stream
    begin: bytes  # of its content
    end: int  # offset of the next page


def _pages(file: BufferedReader, size: int) -> Iterator[_Page]:
    at, ended = 0, False
    while at < size:
        head = _bytes(file, at, 27)
        if not head.startswith(b"OggS") and ended:
            return
        if len(head) == 27 and not head.startswith(b"OggS"):
            raise ValueError(f"expected a page of Ogg at byte {at}, got other data; the file is damaged")
        if len(head) == 27:
            flags, time, serial, number, count = struct.unpack("<5xBqII4xB", head)
            at += 27 + count + sum(file.read(count))
        if len(head) < 27 or at > size:
            raise ValueError("expected a whole page of Ogg at the end, got a part; the file is truncated")
        ended = bool(flags & 4)
        yield _Page(flags, time, serial, number, file.read(32), at)


def _ogg(file: BufferedReader, size: int) -> Header:
    """Check the pages: all of them, in one logical stream of sound, up to its end."""
    numbers: dict[int, int] = {}
    times: list[int] = []
    streams = rate = missing = 0
    begun = ended = False
    for page in _pages(file, size):
        if page.flags & 2:
            streams += begun or page.begin.startswith(_OGG_SOUND)
            rate = rate or _ogg_rate(page.begin)
        begun |= not page.flags & 2
        ended = bool(page.flags & 4)
        missing += page.number != numbers.get(page.serial, page.number - 1) + 1
        numbers[page.serial] = page.number
        times += [page.time] * (page.time > 0)
    if streams > 1:
        raise ValueError(f"expected one stream of sound, got several; {CONVERT}")
    if missing:
        raise ValueError("expected all pages of Ogg, got gaps between them; the file is damaged")
    remark = "the last page of Ogg is not marked as the end; the file may be truncated"
    if ended:
        remark = _tail(file, page.end, size)
    return Header(remark, least=(times[-1] - times[0]) / rate if rate and times else 0.0)


def _ogg_rate(begin: bytes) -> int:
    """Return the number of frames per second that the pages of a stream count; 0 if it is not known."""
    if begin.startswith(b"\x01vorbis"):
        return int.from_bytes(begin[12:16], "little")
    return 48000 if begin.startswith(b"OpusHead") else 0
