"""Octave's decoder on invalid answers: each causes an error immediately, whatever sizes it contains."""

from __future__ import annotations

import os
import random
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosafe import interface
from rosafe.web.genomix import binary_format
from tests.harness import ROOT, proc

LONG = int(os.environ.get("DECODE_FUZZ", "0"))  # number of additional rounds, for example DECODE_FUZZ=100000
SIZES = (1, 2, 255, 65_536, 1_000_000, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 8, 2**32 - 1)


def text(value: str) -> bytes:
    """A name of a level."""
    return binary_format.text(value)


def signal(*levels: tuple[str, int], data: bytes = b"") -> bytes:
    """A signal that claims these levels."""
    sizes = b"".join(text(name) + struct.pack("<I", size) for name, size in levels)
    return binary_format.SIGNAL + struct.pack("<I", len(levels)) + sizes + data


def documents() -> list[bytes]:
    """Answers of all kinds."""
    lags = [[np.arange(3.0) + 10 * channel for channel in range(2)] for _ in range(4)]
    port = {
        "sampleRate": 1,
        "lastFrameIndex": 2,
        "framesOnPort": 3,
        "numberOfChannels": 2,
        "left": lags[0],
        "right": [],
    }
    spectrum = "::rosAFE::TimeFrequencySignalPortStruct"
    return [
        binary_format.plain(
            {"a": [1, 2.5], "b": ["x", "ä€", ""], "c": [], "d": {"::e": True}, "e": {"f": {"g": None}}}
        ),
        binary_format.error({"ex": "::genom::mwerr", "detail": {"what": "no answer"}}),
        b"".join(binary_format.pieces(interface.ROSAFE, "::rosAFE::signalNxND", lags)),
        b"".join(binary_format.pieces(interface.ROSAFE, "::rosAFE::signalND", [np.ones(2), np.zeros(3)])),
        b"".join(binary_format.pieces(interface.ROSAFE, spectrum, port)),
    ]


CRAFTED = [
    # 52 bytes that asked for 4 billion cells
    signal(("dataNxN", 2**32 - 1), ("dataN", 1), ("data", 0)),
    signal(("dataNxN", 0), ("dataN", 2**32 - 1), ("data", 2**32 - 1)),
    signal(("dataN", 2**31), ("data", 2**31), data=bytes(8)),
    signal(("dataN", 2**32 - 1), ("data", 0)),
    signal(("data", 2**32 - 1)),
    signal(*[("a", 1000)] * 7, ("b", 0)),
    signal(*[("a", 0)] * 9),
    signal(),
    signal(("not a name", 1), data=bytes(8)),
    signal(("", 1), data=bytes(8)),
    binary_format.SIGNAL + struct.pack("<I", 2**32 - 1),
    binary_format.NUMBERS + struct.pack("<I", 2**32 - 1) + bytes(16),
    binary_format.NUMBERS + struct.pack("<I", 2**29) + bytes(16),
    binary_format.TEXT + struct.pack("<I", 2**32 - 1) + b"abc",
    binary_format.TEXT + struct.pack("<I", 3) + b"\xff\xfe\xed",
    binary_format.STRUCTURE + b"d" + bytes(8) + binary_format.END,
    binary_format.STRUCTURE + binary_format.member("a"),
    binary_format.STRUCTURE,
    binary_format.SEQUENCE,
    binary_format.SEQUENCE * 1_000,
    binary_format.STRUCTURE
    + binary_format.member("a") * 1
    + (binary_format.STRUCTURE + binary_format.member("a")) * 1_000,
    binary_format.SEQUENCE + (binary_format.STRUCTURE + binary_format.END) * 20_100 + binary_format.END,
    binary_format.STRUCTURE
    + b"".join(binary_format.member(f"a{i}") + binary_format.number(1) for i in range(20_100))
    + binary_format.END,
    binary_format.ERROR,
    binary_format.ERROR + binary_format.number(1),
    binary_format.ERROR + binary_format.plain({"what": "x"}),
    binary_format.ERROR + binary_format.plain({"ex": 7}),
    binary_format.ERROR * 3,
    binary_format.plain({"a": 1}) + b"x",
    b"x",
    b"\0" * 100,
    b"HTTP/1.1 200 OK\r\n\r\n",
    b"<html><body>no</body></html>",
]
GOOD = [signal(("dataN", 31), ("data", 0)), signal(("dataNxN", 1000), ("dataN", 1000), ("data", 0)), *documents()]


def mutants(seed: int, count: int) -> list[bytes]:
    """Truncated answers, answers with changed bytes and counts, and random bytes."""
    chance = random.Random(seed)
    made = [document[:at] for document in documents() for at in range(len(document))] if seed == 0 else []
    made = made[:: 1 + 2 * len(made) // count]
    while len(made) < count:
        data = bytearray(chance.choice(documents()))
        for _ in range(chance.randint(1, 3)):
            at = chance.randrange(len(data))
            kind = chance.random()
            if kind < 0.4:
                data[at : at + 4] = struct.pack("<I", chance.choice(SIZES))
            elif kind < 0.7:
                data[at] = chance.choice(b"dsD[{S!.\0\1\xff" + bytes([chance.randrange(256)]))
            elif kind < 0.85:
                del data[at : at + chance.randint(1, 9)]
            else:
                data[at:at] = chance.choice(documents())
            data = data or bytearray(b"[")
        made.append(bytes(data))
    return made


SCRIPT = r"""
1;
file = fopen('documents');
slowest = 0;
while true
    header = fread(file, 2, 'uint32');
    if isempty(header), break, end
    bytes = uint8(fread(file, header(1), 'uint8').');
    for matrices = [false true]
        begin = cputime();
        told = 'good';
        try
            genomix.wire.decode(bytes, matrices, header(2) == 2);
        catch problem
            told = problem.identifier;
            if any(problem.message == "\n") || numel(problem.message) > 300
                told = ['long: ' problem.message];
            end
        end
        printf('%s\n', told);
        slowest = max(slowest, cputime() - begin);
    end
end
status = fileread('/proc/self/status');
printf('%g %s\n', slowest, regexp(status, 'VmHWM:\s*(\d+)', 'tokens'){1}{1});
"""


def decoded(folder: Path, answers: list[bytes]) -> tuple[list[str], float, float]:
    """Return Octave's result for each, as cells and matrices (``good`` or the error), maximum time (s), memory (MB)."""
    if shutil.which("octave-cli") is None:
        pytest.skip("octave-cli is not installed; scripts/install --tests brings it")
    proc("self", "status")  # the script reads it
    with (folder / "documents").open("wb") as out:
        for number, answer in enumerate(answers):
            out.write(struct.pack("<II", len(answer), 1 + number % 2) + answer)
    (folder / "check.m").write_text(SCRIPT, "utf-8")
    done = subprocess.run(
        ["timeout", "150", "octave-cli", "--norc", "--quiet", "--no-history", "check.m"],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "HOME": str(folder), "OCTAVE_PATH": str(ROOT / "matlab"), "LANG": "C.UTF-8"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    *lines, last = done.stdout.splitlines()
    seconds, kilobytes = last.split()
    return lines, float(seconds), int(kilobytes) / 1024


def check(folder: Path, answers: list[bytes], expected: Any) -> None:
    """All have the results `wanted`, quickly and without much memory."""
    lines, seconds, megabytes = decoded(folder, answers)
    assert len(lines) == 2 * len(answers)
    for number, line in enumerate(lines):
        assert line in expected, (line, answers[number // 2][:200])
    assert seconds < 20  # of processor time
    assert megabytes < 500


def test_crafted_answers(tmp_path: Path) -> None:
    check(tmp_path, CRAFTED, ["genomix:connection"])


def test_good_answers(tmp_path: Path) -> None:
    check(tmp_path, GOOD, ["good"])


@pytest.mark.parametrize("count", [250, pytest.param(3000, marks=pytest.mark.exploration)])
def test_mutants(tmp_path: Path, count: int) -> None:
    check(tmp_path, mutants(0, count), ["good", "genomix:connection"])


@pytest.mark.skipif(not LONG, reason="DECODE_FUZZ says how many")
@pytest.mark.timeout(0)
def test_many_mutants(tmp_path: Path) -> None:
    for seed in range(1, LONG // 5000 + 1):
        check(tmp_path, mutants(seed, 5000), ["good", "genomix:connection"])
