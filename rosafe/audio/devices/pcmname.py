"""Check of ALSA PCM names: libasound evaluates expressions in a name, and some of its plugins run commands."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rosafe.audio.devices.base import device_error

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


@contextmanager
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
