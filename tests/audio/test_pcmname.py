"""PCM names from clients: no name makes libasound run or write anything; harmless names still work."""

from __future__ import annotations

import json
import os
import re
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from rosafe.audio.devices import open_source
from rosafe.audio.devices.alsa import AlsaSource
from rosafe.audio.devices.libasound import checked_name
from rosafe.interface import ComponentError
from rosafe.ros1.transport import paths
from tests.harness import PYTHON, ROOT

RUN = "tee:null,'|touch MARK',raw"
# PCMs that an administrator may have defined, with and without arguments.
CONFIGURATION = """</usr/share/alsa/alsa.conf>
pcm.recorded { type file slave.pcm "null" file /dev/null infile "SAMPLES" format raw }
pcm.logged "tee:null,'LOG',raw"
pcm.rated { @args [ RATE ] @args.RATE { type integer } type rate slave { pcm "null" rate $RATE } }
pcm.alias file
pcm.writer { @args [ F ] @args.F { type string } type file slave.pcm "null" file $F format raw }
pcm.hidden {
    @args [ F ] @args.F { type string }
    type plug slave.pcm { @func concat strings [ "tee:null,'" $F "',raw" ] }
}
pcm.any { @args [ T ] @args.T { type string } type $T slave.pcm "null" file MARK format raw }
pcm.foreign { @args [ A ] @args.A { type string } type someones slave.pcm $A }
pcm.endless {
    @args [ A ] @args.A { type string default "a" }
    type plug slave.pcm { @func concat strings [ "endless:a" $A ] }
}
pcm_slave.writer { @args [ F ] @args.F { type string } pcm { type file slave.pcm "null" file $F format raw } }
pcm.slave { @args [ S ] @args.S { type string } type plug slave $S }
"""
HEADS = (
    *("hw", "plughw", "plug", "null", "tee", "file", "shm", "default", "sysdefault", "front", "iec958", "spdif"),
    *("hdmi", "dmix", "dsnoop", "pulse", "jack", "oss", "a52", "speex", "upmix", "vdownmix", "usbstream", "lavrate"),
    *("samplerate", "speexrate", "recorded", "logged", "rated", "alias", "writer", "hidden", "any", "foreign"),
    *("endless", "slave", "pcm.file", "pcm.tee", "ctl.shm", "pcm_slave.writer", "cards.pcm.default", "_ucm0001.hw"),
    *("nosuch",),
)
ARGUMENTS = ("", ":MARK", ":null,MARK,raw", ":0", ":SLAVE=file:MARK", ":'|touch MARK'", ":file:MARK,0", ":=")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create the working directory with the configuration and a file `precious`."""
    paths.prefer_pypi_packages()
    pytest.importorskip("alsaaudio", reason="pyalsaaudio is not here: scripts/install brings it")
    text = CONFIGURATION.replace("SAMPLES", str(tmp_path / "samples.raw")).replace("LOG", str(tmp_path / "log.raw"))
    (tmp_path / "asound.conf").write_text(text)
    (tmp_path / "samples.raw").write_bytes(bytes(80_000))
    (tmp_path / "precious").write_text("precious")
    monkeypatch.setenv("ALSA_CONFIG_PATH", str(tmp_path / "asound.conf"))
    monkeypatch.setenv("PULSE_SERVER", "unix:/nonexistent")
    monkeypatch.setenv("JACK_NO_START_SERVER", "1")
    monkeypatch.chdir(tmp_path)
    return tmp_path


class OpenResult(NamedTuple):
    """The result of opening a name."""

    outcome: str  # "opened", "failed: ..." or "refused: ..."
    written: bool  # whether a file in the folder was created, changed or opened for writing
    run: bool  # whether a command was run


class Opener:
    """The process tests/audio/opener.py, which is restarted if libasound ends it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "opened"
        self._folder.mkdir()
        (self._folder / "MARK").write_text("precious")
        self._process: subprocess.Popen[str] | None = None

    def open(self, name: str, checked: bool = True) -> OpenResult:
        """Open `name`, if it is not rejected."""
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [PYTHON, "-m", "tests.audio.opener"],
                cwd=self._folder,
                env={**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        assert self._process.stdin and self._process.stdout
        print(json.dumps([name, checked]), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        assert answer, f"{name!r} ends the process: {self._process.wait(10)}"
        return OpenResult(*json.loads(answer))

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()


@pytest.fixture
def opener(folder: Path) -> Iterator[Opener]:
    opener = Opener(folder)
    yield opener
    opener.close()


# --- the names --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        RUN,
        "plug:\"file:'|touch MARK',raw\"",
        "plug:SLAVE='file:FILE=|touch MARK'",
        "plug:{SLAVE=\"file:'|touch MARK',raw\"}",
        "{type file slave.pcm null file MARK}",
        "file:{FILE MARK}",
        "tee:null,MARK,raw",
        "tee:SLAVE=null,FILE=MARK",
        "file:MARK",
        "alias:MARK",
        "plug:file:MARK",
        "plug:SLAVE=tee:null,MARK",
        "plug:alias:MARK",
        "speex:SLAVE=file:MARK",
        "lavrate:SLAVE=file:MARK,RATE=8000",
        "a52:0,file:MARK",
        "writer:MARK",
        "hidden:MARK",
        "plug:hidden:MARK",
        "any:file",
        "any:shm",
        "shm:a,b",
        "oss:MARK",
        "foreign:hw",
        "endless:a",
        "hw:$HOME",
        *(f"hw:0{sign}" for sign in "@}|; \\()[]<>&#!~*"),
        " hw:0",
        "hw=0:1",
        "hw,0",
        "hw:0\n",
        "hw:\0",
        "hw:\u0661",  # an Arabic digit
        "\u0397w:0",
        "../asound.conf",
        "/dev/snd/pcmC0D0c",
        "",
        ":",
        ":0",
        "hw:" + "A" * 256 + "=1",  # ends the process if libasound gets it
        "A" * 1_000_000,
    ],
)
def test_unsafe_names_are_rejected(folder: Path, name: str) -> None:
    opening = AlsaSource if name.startswith("file:") else open_source  # the built-in source of bass
    with pytest.raises(ComponentError) as caught:
        opening(name, 44100, 2205, threading.Event())
    assert caught.value.ex == "::bass::e_device"
    assert re.search("the name of a PCM|uses ALSA's plugin|nested PCMs|the name of a device", caught.value.reason)
    assert len(caught.value.reason) < 500 and caught.value.reason.isprintable()
    assert sorted(os.listdir(folder)) == ["asound.conf", "precious", "samples.raw"]


@pytest.mark.parametrize(
    ("name", "opened"),
    [
        ("hw:1,0", None),
        ("hw:CARD=PCH,DEV=0,SUBDEV=1", None),
        ("plughw:CARD=Mic_1", None),
        ("default", None),
        ("sysdefault:CARD=PCH", None),
        ("front:CARD=PCH,DEV=0", None),
        ("dsnoop:CARD=PCH,DEV=0", None),
        ("plug:default", None),
        ("plug:SLAVE=hw", None),
        ("plug:hw:1", None),
        ("plug:hw:1,0", "plug:'hw:1,0'"),
        ("plug:dsnoop:CARD=PCH,DEV=0", "plug:'dsnoop:CARD=PCH,DEV=0'"),
        ("plug:SLAVE=dsnoop:1,0", "plug:'dsnoop:1,0'"),
        ("pulse:alsa_input.usb-C-Media_Electronics-00.analog-stereo", None),
        ("bluealsa:DEV=00:11:22:33:44:55,PROFILE=sco", None),
        ("recorded", None),
        ("plug:recorded", None),
        ("rated:48000", None),
        ("logged", None),
        ("nosuch", None),
    ],
)
def test_safe_names_are_accepted(folder: Path, name: str, opened: str | None) -> None:
    assert checked_name(name) == (opened or name)


def test_pcms_of_the_configuration_can_be_opened_by_plain_name(folder: Path) -> None:
    """Also those that write a file: the configuration is trusted. tests/audio/test_alsa.py reads one."""
    (folder / "samples.raw").write_bytes(bytes(8 * 1000))
    source = open_source("logged", 44100, 500, threading.Event())
    assert source.read() is not None
    source.close()
    assert (folder / "log.raw").exists()


def test_the_documented_sharing_of_a_device_is_accepted(folder: Path) -> None:
    """The only error of libasound is that this machine has no such card."""
    page = (ROOT / "docs" / "capture.md").read_text("utf-8")
    (recipe,) = re.findall(r"^  ```\n(  pcm\.mics \{.*?)^  ```$", page, re.MULTILINE | re.DOTALL)
    recipe = recipe.replace("hw:1,0", "hw:77,0")
    with (folder / "asound.conf").open("a") as configuration:
        configuration.write(recipe)
    assert checked_name("ears") == "ears"
    with pytest.raises(ComponentError) as refused:
        open_source("ears", 44100, 2205, threading.Event())
    assert refused.value.what == "ears: Invalid argument (Cannot get card index for 77)"


def test_the_slave_of_plug_can_have_several_arguments(opener: Opener) -> None:
    """libasound itself would assign them to plug."""
    assert opener.open("plug:rated:RATE=48000", checked=False).outcome.startswith("failed: No such file")
    assert opener.open("plug:rated:RATE=48000").outcome == "opened"
    assert opener.open("plug:speex:SLAVE=null,AGC=on").outcome == "opened"


# --- effects in libasound ------------------------------------------------------------------------------


def test_the_opener_detects_writes_and_commands(opener: Opener) -> None:
    for name in (RUN, "tee:null,MARK,raw", "plug:'file:MARK'", "hidden:MARK"):
        result = opener.open(name, checked=False)
        assert result.written and result.run == ("|" in name), name


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.exploration)])
def test_no_name_of_this_machine_is_harmful(opener: Opener, step: int) -> None:
    """Each name with some of the arguments, or with all."""
    for number, head in enumerate(HEADS):
        for arguments in ARGUMENTS[number % step :: step]:
            if head != "logged" or arguments:
                result = opener.open(head + arguments)
                assert not (result.written or result.run), (head + arguments, result)
