"""Access to libasound: a working version of its binding, its error messages, capture devices, and safe names of PCMs.

libasound evaluates expressions in a name, and some of its plugins run commands: `checked_name` admits no such names.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import platform
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rosafe import interface
from rosafe.audio.devices.base import device_error
from rosafe.system import missing

# libasound evaluates nothing in a name without quotes, braces, pipes, slashes and blanks. It ends the process if the
# name of a parameter has 256 characters.
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,100}(:[A-Za-z0-9_.,:=-]{0,150})?")
# Plugins that a name with arguments may use. Excluded: `file` (commands, files), `shm`, `share`, `oss`, `ladspa`,
# `meter`, and all third-party plugins.
_PLUGINS = {
    *("a52", "adpcm", "alaw", "asym", "bluealsa", "copy", "ctl_elems", "dmix", "dshare", "dsnoop", "empty", "hooks"),
    *("hw", "iec958", "jack", "lfloat", "linear", "mmap_emul", "mulaw", "multi", "null", "pipewire", "plug", "pulse"),
    *("rate", "route", "softvol", "speex", "upmix", "usb_stream"),
}
_MAX_DEFINITIONS = 64  # that one name may refer to, directly or indirectly; libasound's own limit
_COMPOUND = 1024  # SND_CONFIG_TYPE_COMPOUND
_ITERATOR = ("iterator_first", "iterator_next", "iterator_end", "iterator_entry")
_Node = ctypes.c_void_p
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


# --- names ------------------------------------------------------------------------------------------------------------


def checked_name(name: str) -> str:
    """Return the name of a PCM in the form in which libasound can open it safely.

    A name without arguments denotes a PCM of the machine's own configuration, which is trusted. A name with arguments
    may only use plugins that do not write, execute or load anything.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_device`` for any other name; nothing has been opened then.
    """
    if not _NAME.fullmatch(name):
        short = name if len(name) <= 80 else name[:77] + "..."
        raise device_error(
            f"{short if name and name.isprintable() else repr(short)}: expected the name of a PCM: NAME or "
            "NAME:ARGUMENTS, at most 100 and 150 characters: letters, digits and _ - . , : ="
        )
    head, colon, arguments = name.partition(":")
    if not colon:
        return name
    slave = arguments.removeprefix("SLAVE=")
    if head == "plug" and re.search("[,=]", slave):
        name = f"plug:'{slave}'"  # libasound would assign the arguments of the slave to plug
    for plugin in _plugins(name):
        if plugin not in _PLUGINS:
            raise device_error(
                f"{head}:{arguments} uses ALSA's plugin {plugin}, which can write files or run commands; define such a "
                "PCM in ALSA's configuration, and use its name without arguments"
            )
    return name


def _plugins(name: str) -> Iterator[str]:
    """Yield the types of all PCMs that libasound would open for `name`."""
    names = [name]
    with _configuration() as definition:
        for count, nested in enumerate(names):
            if count == _MAX_DEFINITIONS:
                raise device_error(f"{name}: expected at most {_MAX_DEFINITIONS} nested PCMs, got more")
            for base in (b"pcm", b"pcm_slave"):
                for key, value in definition(base, nested):
                    if key == "type":
                        yield value
                    elif ":" in value and value not in names:  # the name of a slave with arguments, if it is a name
                        names.append(value)


@contextlib.contextmanager
def _configuration() -> Iterator[Callable[[bytes, str], list[tuple[str, str]]]]:
    """Return a function that looks up a name in libasound's configuration and returns its keys and string values.

    The result is empty for a name that is not defined, and that therefore cannot be opened.
    """
    try:
        library = ctypes.CDLL("libasound.so.2")
    except OSError as problem:
        raise device_error(f"cannot load libasound ({problem}); install it with scripts/install") from None
    library.snd_config_search_definition.argtypes = (_Node, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)
    for name in ("unref", "delete", "get_type", *_ITERATOR):
        getattr(library, f"snd_config_{name}").argtypes = (_Node,)
    for name in _ITERATOR:
        getattr(library, f"snd_config_{name}").restype = _Node
    for name in ("get_id", "get_string"):
        getattr(library, f"snd_config_{name}").argtypes = (_Node, ctypes.c_void_p)
    top = _Node()
    if library.snd_config_update_ref(ctypes.byref(top)) < 0:
        raise device_error("cannot read ALSA's configuration; `arecord -L` shows the reason")

    def definition(base: bytes, name: str) -> list[tuple[str, str]]:
        node = _Node()
        if library.snd_config_search_definition(top, base, name.encode(), ctypes.byref(node)) < 0:
            return []
        try:
            return list(_strings(library, node))
        finally:
            library.snd_config_delete(node)

    try:
        yield definition
    finally:
        library.snd_config_unref(top)


def _strings(library: Any, node: Any) -> Iterator[tuple[str, str]]:
    """Yield keys and values of all strings in a node of the configuration and its descendants."""
    if library.snd_config_get_type(node) == _COMPOUND:
        position = library.snd_config_iterator_first(node)
        while position != library.snd_config_iterator_end(node):
            yield from _strings(library, library.snd_config_iterator_entry(position))
            position = library.snd_config_iterator_next(position)
        return
    key, value = ctypes.c_char_p(), ctypes.c_char_p()
    if library.snd_config_get_string(node, ctypes.byref(value)) == 0 and value.value is not None:
        library.snd_config_get_id(node, ctypes.byref(key))
        yield (key.value or b"").decode(errors="replace"), value.value.decode(errors="replace")
