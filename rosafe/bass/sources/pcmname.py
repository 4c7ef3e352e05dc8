"""Which names of ALSA PCMs bass opens: libasound evaluates what stands in a name, and some plugins run commands."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rosafe.bass.sources.base import device_error

# Without quotes, braces, pipes, slashes and blanks there is nothing to evaluate. libasound itself would end the
# process at a parameter's name of 256 characters.
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,100}(:[A-Za-z0-9_.,:=-]{0,150})?")
# What a name with arguments may reach. Not among them: `file` (commands, files), `shm`, `share`, `oss`, `ladspa`,
# `meter`, and whatever somebody else has made.
_PLUGINS = {
    *("a52", "adpcm", "alaw", "asym", "bluealsa", "copy", "ctl_elems", "dmix", "dshare", "dsnoop", "empty", "hooks"),
    *("hw", "iec958", "jack", "lfloat", "linear", "mmap_emul", "mulaw", "multi", "null", "pipewire", "plug", "pulse"),
    *("rate", "route", "softvol", "speex", "upmix", "usb_stream"),
}
_MAX_DEFINITIONS = 64  # that one name may reach, one through the other; libasound's own limit
_COMPOUND = 1024  # SND_CONFIG_TYPE_COMPOUND
_Node = ctypes.c_void_p


def checked_name(name: str) -> str:
    """`name`, as libasound is to be asked for it.

    A name without arguments stands for what the machine's own configuration says, whatever that is. One with arguments
    may only reach plugins that neither write nor run nor load anything.

    Raises
    ------
    interface.ComponentError
        ``::bass::e_device`` for any other name; nothing has been opened then.
    """
    if not _NAME.fullmatch(name):
        short = name if len(name) <= 80 else name[:77] + "..."
        raise device_error(
            f"{short if name and name.isprintable() else repr(short)}: this is no name of a PCM; wanted is NAME or "
            "NAME:ARGUMENTS, at most 100 and 150 characters out of letters, digits and _ - . , : ="
        )
    head, colon, arguments = name.partition(":")
    if not colon:
        return name
    slave = arguments.removeprefix("SLAVE=")
    if head == "plug" and re.search("[,=]", slave):
        name = f"plug:'{slave}'"  # the slave's arguments, which libasound would take for plug's
    for plugin in _plugins(name):
        if plugin not in _PLUGINS:
            raise device_error(
                f"{head}:{arguments} reaches ALSA's plugin {plugin}, which may write or run something: only a PCM that "
                "is defined so in ALSA's configuration may do that, under its plain name"
            )
    return name


def _plugins(name: str) -> Iterator[str]:
    """The types of all that libasound would open for `name`."""
    names = [name]
    with _configuration() as definition:
        for count, nested in enumerate(names):
            if count == _MAX_DEFINITIONS:
                raise device_error(f"{name} reaches more than {_MAX_DEFINITIONS} PCMs")
            for base in (b"pcm", b"pcm_slave"):
                for key, value in definition(base, nested):
                    if key == "type":
                        yield value
                    elif ":" in value and value not in names:  # if it is a slave's name, then one with arguments
                        names.append(value)


@contextmanager
def _configuration() -> Iterator[Callable[[bytes, str], list[tuple[str, str]]]]:
    """A function that looks a name up in libasound's configuration, as opening it does, and returns all its strings.

    Each comes with its key. What is not there has none; to open it will fail.
    """
    try:
        library = ctypes.CDLL("libasound.so.2")
    except OSError as problem:
        raise device_error(f"ALSA's library cannot be used ({problem}); scripts/install brings it") from None
    library.snd_config_search_definition.argtypes = (_Node, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)
    for function in ("unref", "delete"):
        getattr(library, f"snd_config_{function}").argtypes = (_Node,)
    top = _Node()
    if library.snd_config_update_ref(ctypes.byref(top)) < 0:
        raise device_error("ALSA's configuration cannot be read; `arecord -L` says more")

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
    """Keys and values of all strings at and below a node of the configuration."""
    for function in ("first", "next", "end", "entry"):
        iterator = getattr(library, f"snd_config_iterator_{function}")
        iterator.argtypes, iterator.restype = (_Node,), _Node
    for function in ("get_id", "get_string"):
        getattr(library, f"snd_config_{function}").argtypes = (_Node, ctypes.c_void_p)
    library.snd_config_get_type.argtypes = (_Node,)
    if library.snd_config_get_type(node) == _COMPOUND:
        place = library.snd_config_iterator_first(node)
        while place != library.snd_config_iterator_end(node):
            yield from _strings(library, library.snd_config_iterator_entry(place))
            place = library.snd_config_iterator_next(place)
        return
    key, value = ctypes.c_char_p(), ctypes.c_char_p()
    if library.snd_config_get_string(node, ctypes.byref(value)) == 0 and value.value is not None:
        library.snd_config_get_id(node, ctypes.byref(key))
        yield (key.value or b"").decode(errors="replace"), value.value.decode(errors="replace")
