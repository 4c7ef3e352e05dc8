"""The reference of all requests as a Markdown document: docs/parameters.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rosafe.declarations.idl import ros_type
from rosafe.declarations.parameter import REQUIRED, Parameter, format_value
from rosafe.declarations.representation import Representation

from .remarks import PRESETS
from .service import ComponentSpec, PortSpec, Service

PRESETS_HEAD = """## Presets

`rosafe.PRESETS`, `--preset` of `rosafe process` and `rosafe plot`, and `preset` in a setup are parameters for a
purpose.

`speech`: the pitch of voices from 60 to 400 Hz, at sample rates from 16 kHz. Share of frames within 50 cents for 84
synthetic vowels (random formants, four glottal pulses, fixed and gliding pitch, without noise and at 20, 10 and 5 dB,
16 kHz), beside a window of 60 ms with `ac_K` = 2, `pi_confThres` = 0.2 and `pi_peakRatio` = 1:

| pitch (Hz) | 60 to 80 | 80 to 120 | 120 to 180 | 180 to 250 | 250 to 300 | 300 to 350 | 350 to 395 |
| --- | --- | --- | --- | --- | --- | --- | --- |
| preset | 0.86 | 1.00 | 0.98 | 1.00 | 1.00 | 1.00 | 1.00 |
| highest peak, `ac_K` = 2 | 0.74 | 1.00 | 1.00 | 1.00 | 0.98 | 0.90 | 0.87 |

With windows of 64 ms, `librosa.pyin` reaches 1.00 in every column; it also uses the continuity of the pitch.
`pi_peakRatio` below 1 finds high pitches in place of the octave below, and in noise sometimes the octave above low
pitches: in 42 other vowels at 20, 10 and 5 dB, the share is 0.90 from 180 to 250 Hz (0.99 with the settings of the last
row) and 0.88 from 80 to 120 Hz (0.89). For voices that stay below 250 Hz, set `pi_peakRatio` to 1.

In two synthetic sentences and two recordings of speech, 82 to 94 % of the frames that `pyin` takes as voiced are within
50 cents of it. In a synthetic voice of 280 Hz (espeak-ng es+f1), 45 % of these frames are an octave below `pyin`. The
defaults, which are those of the original, suit pitches above 150 Hz.

`onsets`: onset and offset maps without marks in steady noise and in muted inputs. docs/onset-maps.md has its errors and
those of the defaults.

| preset | parameter | value |
| --- | --- | --- |"""


def markdown(components: Iterable[ComponentSpec], kinds: Mapping[str, Representation]) -> str:
    """Return the complete document."""
    lines = [Path(__file__).with_name("parameters_head.md").read_text("utf-8")]
    for component in components:
        lines += _component(component, kinds)
    return "\n".join([*lines, *_presets()])


def _presets() -> Iterator[str]:
    yield PRESETS_HEAD
    for name, values in PRESETS.items():
        yield from (f"| `{name}` | `{parameter}` | {format_value(value)} |" for parameter, value in values.items())
    yield ""


def _component(component: ComponentSpec, kinds: Mapping[str, Representation]) -> Iterator[str]:
    yield f"## {component.name}\n"
    yield f"{component.doc}.\n"
    for service in component.on_graph:
        yield from _service(component, service, kinds)
    yield f"### Ports of {component.name}\n"
    rows = [(_topic(component, port), f"`{ros_type(port.idl)}`", _port_doc(port)) for port in component.ports]
    yield _table(("port", "type", "content"), rows)
    yield f"### Exceptions of {component.name}\n"
    yield _table(
        ("exception", "meaning"),
        [(f"`::{component.name}::{name}`", meaning) for name, meaning in component.exceptions.items()],
    )


def _service(component: ComponentSpec, service: Service, kinds: Mapping[str, Representation]) -> Iterator[str]:
    yield f"### {service.name}" + (" (activity)" if service.activity else "") + "\n"
    yield f"{service.doc}.\n"
    if service.parameters:
        yield _table(("parameter", "type", "default", "allowed", "meaning"), [_row(p) for p in service.parameters])
    for kind in kinds.values():
        if kind.request == service.name and not set(kind.parameters) <= set(service.parameters):
            yield "Only with `modifyParameter` or in `rosafe.process`:\n"
            yield _table(("parameter", "type", "default", "allowed", "meaning"), [_row(p) for p in kind.parameters])
    if service.outputs:
        yield "Returns " + ", ".join(f"`{name}` ({_type(idl)})" for name, idl in service.outputs) + ".\n"
    if service.throws:
        yield "Exceptions: " + ", ".join(f"`{ex}`" for ex in service.throws) + ".\n"


def _row(parameter: Parameter) -> tuple[str, ...]:
    text = _text(parameter.default)
    default = "required" if parameter.default is REQUIRED else f"`{text}`" if text else "empty"
    return f"`{parameter.name}`", _type(parameter.idl), default, parameter.range_text, parameter.doc


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_text, value)) + "]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _type(idl: str) -> str:
    return f"`{ros_type(idl)}`"


def _topic(component: ComponentSpec, port: PortSpec) -> str:
    name = f"/{component.name}/{port.name}" + ("/<name>" if port.multiple else "")
    return f"`{name}`" if port.output else f"`{port.name}` (input, see connect_port)"


def _port_doc(port: PortSpec) -> str:
    return port.doc + ("; one topic per processor" if port.multiple else "")


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
