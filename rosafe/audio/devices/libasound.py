"""Access to libasound: a working version of its binding, its error messages, and the list of capture devices."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosafe import interface
from rosafe.audio.devices.base import device_error
from rosafe.system import missing

_HANDLER = ctypes.CFUNCTYPE(
    None, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p
)
# Machines on which a va_list argument is passed as a pointer, so that a callback can forward it.
_POINTER_VA_LIST = ("x86_64", "aarch64")


def load_alsaaudio() -> Any:
    """Return the module `alsaaudio` of pyalsaaudio 0.11 or later. Raises ``::bass::e_device``."""
    try:
        module = importlib.import_module("alsaaudio")
    except ImportError as problem:
        raise device_error(f"ALSA devices need pyalsaaudio ({problem}); {missing.install('alsaaudio')}") from None
    if not hasattr(module, "asoundlib_version"):
        raise device_error(
            f"{module.__file__} is Debian's python3-alsaaudio 0.8, which cannot capture on this Python; "
            "install pyalsaaudio 0.11 with scripts/install"
        )
    return module


@contextlib.contextmanager
def captured_alsa_errors() -> Iterator[list[str]]:
    """Collect the messages that libasound would print on stderr for this thread, one line each."""
    messages: list[str] = []
    try:
        library, libc = ctypes.CDLL("libasound.so.2"), ctypes.CDLL(None)
    except OSError:
        yield messages
        return

    def collect(_file: bytes, _line: int, _function: bytes, _error: int, form: bytes, arguments: int) -> None:
        text = ctypes.create_string_buffer(500)
        if platform.machine() in _POINTER_VA_LIST:
            libc.vsnprintf(text, ctypes.c_size_t(len(text)), form, ctypes.c_void_p(arguments))
        else:
            text.value = form[:499]
        messages.append(" ".join(text.value.decode(errors="replace").split()))

    handler = _HANDLER(collect)
    library.snd_lib_error_set_local.argtypes = (ctypes.c_void_p,)
    library.snd_lib_error_set_local.restype = ctypes.c_void_p
    before = library.snd_lib_error_set_local(ctypes.cast(handler, ctypes.c_void_p))
    try:
        yield messages
    finally:
        library.snd_lib_error_set_local(before)


def forget_configuration() -> None:
    """Let libasound read its configuration again: by itself it notices changes of alsa.conf, but not of ~/.asoundrc."""
    with contextlib.suppress(OSError):
        ctypes.CDLL("libasound.so.2").snd_config_update_free_global()


def capture_devices(proc: Path = Path("/proc/asound")) -> list[tuple[int, int, str, str]]:
    """Return (card, device, card id, PCM id) of the capture PCMs of all sound cards, as listed by the kernel in `proc`.

    Raises ``::bass::e_nodevice`` if there is no sound card.
    """
    cards = sorted(proc.glob("card[0-9]*"), key=lambda path: int(path.name[len("card") :]))
    if not cards:
        raise interface.BASS.error("e_nodevice", f"no sound card ({proc}/card* is empty)")
    found = []
    for card in cards:
        with contextlib.suppress(FileNotFoundError):  # a card that is being unplugged
            card_id = (card / "id").read_text().strip()
            for info in sorted(card.glob("pcm*c/info"), key=lambda path: int(path.parent.name[3:-1])):
                fields = dict(line.partition(": ")[::2] for line in info.read_text().splitlines())
                found.append((int(fields["card"]), int(fields["device"]), card_id, fields["id"].strip()))
    return found
