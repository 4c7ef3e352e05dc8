"""The packed format: encoded values are decoded to equal values, in Python and in Octave."""

from __future__ import annotations

import http.client
import json
import math
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe import interface
from rosafe.web.genomix import binary_format
from tests.harness import PATIENCE, ROOT
from tests.web.genomix.world import World

SPECTRUM = "::rosAFE::TimeFrequencySignalPortStruct"


class Reader:
    """A decoder of the packed format, written according to docs/genomixd.md."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, count: int) -> bytes:
        """The next bytes."""
        self._at += count
        assert self._at <= len(self._data)
        return self._data[self._at - count : self._at]

    def count(self) -> int:
        """A count."""
        return int(struct.unpack("<I", self.take(4))[0])

    def text(self) -> str:
        """Count and UTF-8."""
        return self.take(self.count()).decode()

    def numbers(self, count: int) -> Any:
        """An array of numbers."""
        return np.frombuffer(self.take(8 * count), "<f8")

    def until_end(self) -> bool:
        """Return whether a sequence or structure continues."""
        if self._data[self._at : self._at + 1] == binary_format.END:
            self._at += 1
            return False
        return True

    def value(self) -> Any:
        """Any value; a signal as (names, array)."""
        kind = self.take(1)
        if kind == binary_format.NUMBER:
            return float(self.numbers(1)[0])
        if kind == binary_format.TEXT:
            return self.text()
        if kind == binary_format.NUMBERS:
            return self.numbers(self.count())
        if kind == binary_format.SIGNAL:
            levels = [(self.text(), self.count()) for _ in range(self.count())]
            shape = [size for _, size in levels]
            return [name for name, _ in levels], self.numbers(math.prod(shape)).reshape(shape)
        if kind == binary_format.SEQUENCE:
            items = []
            while self.until_end():
                items.append(self.value())
            return items
        assert kind in (binary_format.STRUCTURE, binary_format.ERROR), kind
        if kind == binary_format.ERROR:
            return {"!": self.value()}
        members = {}
        while self.until_end():
            assert self.take(1) == binary_format.TEXT
            name = self.text()
            members[name] = self.value()
        return members


def read(data: bytes) -> Any:
    """Return the value of `data`, which must be complete."""
    reader = Reader(data)
    value = reader.value()
    assert reader.take(len(data) - reader._at) == b""
    return value


leaves = st.one_of(st.floats(allow_nan=False), st.booleans(), st.text(st.characters(blacklist_categories=["Cs"])))
values = st.recursive(leaves, lambda inner: st.lists(inner) | st.dictionaries(st.text("ab_:"), inner), max_leaves=20)


def same(found: Any, value: Any) -> bool:
    """Return whether values are equal: sequences of numbers are arrays, booleans are numbers."""
    if isinstance(value, dict):
        return list(found) == list(value) and all(same(found[k], v) for k, v in value.items())
    if isinstance(value, list):
        return len(found) == len(value) and all(map(same, found, value))
    return bool(found == value)


@settings(max_examples=20, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(values)
def test_plain_values_read_back(value: Any) -> None:
    assert same(read(binary_format.plain(value)), value)


@settings(max_examples=30, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.lists(st.floats(allow_nan=False), max_size=4), max_size=4), st.booleans())
def test_signals_read_back(channels: list[list[float]], alike: bool) -> None:
    """One array if all channels have the same number of frames, otherwise nested structures."""
    if alike:
        channels = [(channel + [0.0] * 4)[:3] for channel in channels]
    arrays = [np.array(channel) for channel in channels]
    port = {"sampleRate": 1, "lastFrameIndex": 2**53, "framesOnPort": 3, "numberOfChannels": 4, "left": arrays}
    data = b"".join(binary_format.pieces(interface.ROSAFE, SPECTRUM, {**port, "right": []}))
    found = read(data)
    assert list(found) == [name for name, _ in interface.ROSAFE.structs[SPECTRUM]]
    assert found["lastFrameIndex"] == 2**53
    if len({len(channel) for channel in channels}) <= 1:
        names, block = found["left"]
        assert names == ["dataN", "data"] and block.tolist() == channels
    else:
        assert [one[1].tolist() for one in found["left"]["dataN"]] == channels
    assert found["right"][1].shape == (0, 0)


def test_special_numbers_and_texts() -> None:
    assert math.isnan(read(binary_format.plain(None)))
    assert math.isnan(read(binary_format.plain(math.nan)))
    assert read(binary_format.plain([math.inf, 1])).tolist() == [math.inf, 1]
    assert read(binary_format.plain("\ud800")) == "\\ud800"
    assert read(binary_format.error({"ex": "::genom::syserr", "detail": {"code": 11}})) == {
        "!": {"ex": "::genom::syserr", "detail": {"code": 11}}
    }


def test_octave_reads_the_same(tmp_path: Path) -> None:
    """The decoder of matlab/ returns cells, or matrices on request."""
    if shutil.which("octave-cli") is None:
        pytest.skip("octave-cli is not installed; scripts/install --tests brings it")
    lags = [[np.arange(3.0) + 10 * channel + 100 * lag for channel in range(2)] for lag in range(4)]
    correlation = b"".join(binary_format.pieces(interface.ROSAFE, "::rosAFE::signalNxND", lags))
    documents = {
        "plain": binary_format.plain(
            {"a": [1, 2.5, math.nan], "b": ["x", "äß€", ""], "c": [], "d": {"::e": True}, "e": []}
        ),
        "lags": correlation,
        "ragged": b"".join(binary_format.pieces(interface.ROSAFE, "::rosAFE::signalND", [np.ones(2), np.zeros(3)])),
        "error": binary_format.error({"ex": "x"}),
        "empty": b"".join(binary_format.pieces(interface.ROSAFE, "::rosAFE::signalNxND", [[np.empty(0), np.empty(0)]])),
    }
    for name, data in documents.items():
        (tmp_path / name).write_bytes(data)
    script = r"""
    function [value, failed] = get(name, matrices, columns = false)
        file = fopen(name);
        [value, failed] = genomix.wire.decode(uint8(fread(file, Inf).'), matrices, columns);
        fclose(file);
    end
    p = get('plain', false);
    assert(iscell(p.a) && isequal(size(p.a), [1 3]) && p.a{2} == 2.5 && isnan(p.a{3}))
    assert(isequal(p.b, {'x', 'äß€', ''}) && isequal(size(p.c), [1 0]) && iscell(p.c))
    t = get('plain', false, true);
    assert(isequal(t.a(1:2), {1; 2.5}) && isequal(t.b, {'x'; 'äß€'; ''}) && isequal(size(t.c), [0 1]))
    m = get('plain', true);
    assert(isa(m.a, 'double') && m.a(1) == 1 && iscell(m.b))
    c = get('lags', false);
    assert(isequal(size(c.dataNxN), [1 4]) && isequal(c.dataNxN{3}.dataN{2}.data, {210, 211, 212}))
    c = get('lags', false, true);
    assert(isequal(size(c.dataNxN), [4 1]) && isequal(c.dataNxN{3}.dataN{2}.data, {210; 211; 212}))
    e = get('empty', false);
    none = struct('data', {cell(1, 0)});
    assert(isequal(e, struct('dataNxN', {{struct('dataN', {{none, none}})}})))
    assert(isequal(size(get('empty', true)), [0 2]))
    m = get('lags', true);
    assert(isequal(size(m), [3 2 4]) && isequal(m(:, 2, 3), [210; 211; 212]))
    r = get('ragged', true);
    assert(isequal(r.dataN{1}, [1; 1]) && isequal(r.dataN{2}, [0; 0; 0]))
    [e, failed] = get('error', false);
    assert(failed && strcmp(e.ex, 'x'))
    sent = {1, -0.1, 1/3, true, int32(7), 'a"\', {}, [], {1, {'x'}}, [1 2; 3 4], struct('a', {{}}), NaN, -Inf, 1e300};
    printf('%s\n', genomix.wire.encode(sent))
    printf('%s\n', genomix.wire.encode(sprintf('a\tb\nc')), genomix.wire.quote('ä b&c/d%_-.~'))
    try
        genomix.wire.encode({@sin})
    catch problem
        printf('%s\n', problem.identifier)
    end
    """
    (tmp_path / "check.m").write_text("1;\n" + script, "utf-8")
    done = subprocess.run(
        ["timeout", "120", "octave-cli", "--norc", "--quiet", "--no-history", "check.m"],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "OCTAVE_PATH": str(ROOT / "matlab"), "LANG": "C.UTF-8"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    sent, text, quoted, refused = done.stdout.splitlines()
    wanted = [1, -0.1, 1 / 3, 1, 7, 'a"\\', [], [], [1, ["x"]], [1, 3, 2, 4], {"a": []}]
    *most, nan, infinite, large = json.loads(sent)
    assert most == wanted and math.isnan(nan) and infinite == -math.inf and large == 1e300
    assert json.loads(text) == "a\tb\nc"
    assert quoted == "%C3%A4%20b%26c%2Fd%25_-.~"
    assert refused == "genomix:argument"


@pytest.mark.ros
def test_the_server_answers_packed(world: World) -> None:
    """The same as in JSON; errors with HTTP status 200, marked."""

    def get(url: str) -> Any:
        connection = http.client.HTTPConnection("127.0.0.1", world.port, timeout=PATIENCE)
        connection.request("GET", url)
        response = connection.getresponse()
        assert response.status == 200
        assert response.getheader("Content-Type") == "application/octet-stream"
        return read(response.read())

    about = get("/load/rosAFE?syntax=packed&s=p")
    wanted = world.http.get("/load/rosAFE")
    assert list(about["services"]) == list(wanted["services"]) and about["doc"] == wanted["doc"]
    assert get("/call/rosAFE/removeProcessor?syntax=packed&input=[%22x%22]") == {
        "!": {"ex": "::rosAFE::e_noSuchProcessor", "what": "there is no processor 'x'; there are: none"}
    }
    assert get("/nowhere?syntax=packed")["!"]["ex"] == "::genomix::e_url"
    world.http.call("bass/Acquire", ["scene:"])
    sent = get("/send/rosAFE/getParameters?syntax=packed&s=p&ack=1")
    assert get(f"/request/wait?syntax=packed&s=p&id={sent['id']}")["output"]["parameters"]["ild"] == []
    world.http.call("bass/Stop")
    audio, as_json = get("/call/bass/Audio?syntax=packed")["Audio"], world.http.call("bass/Audio")["Audio"]
    assert audio["left"].tolist() == as_json["left"] and len(as_json["left"]) == 44100
    assert audio["stamp"] == as_json["stamp"]


def test_numbers_beyond_the_range_of_floats() -> None:
    """A component's error may hold any number that JSON has."""
    huge = 10**4000
    assert binary_format.plain(huge) == binary_format.plain(math.inf)
    assert binary_format.plain([-huge, 1]) == binary_format.plain([-math.inf, 1])
