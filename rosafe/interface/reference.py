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

`speech`: the pitch of voices from 80 to 400 Hz, at sample rates from 16 kHz. `pi_rangeHz` is wider because its ends are
not found. Share of frames within 50 cents for 288 synthetic vowels (random formants, four glottal pulses, fixed and
gliding pitch, jitter, without noise and at 20, 10 and 5 dB, 16 kHz; the values were chosen with others), beside a
window of 60 ms with `ac_K` = 2, `pi_rangeHz` = 60, 400, `pi_confThres` = 0.2 and `pi_peakRatio` = 1, and beside
`librosa.pyin` with windows of 64 ms:

| pitch (Hz) | 80 to 120 | 120 to 180 | 180 to 250 | 250 to 300 | 300 to 350 | 350 to 395 |
| --- | --- | --- | --- | --- | --- | --- |
| preset | 0.97 | 1.00 | 0.99 | 1.00 | 1.00 | 1.00 |
| highest peak, `ac_K` = 2 | 0.94 | 1.00 | 1.00 | 0.96 | 0.88 | 0.84 |
| `pyin` | 1.00 | 1.00 | 1.00 | 0.99 | 1.00 | 1.00 |
| preset, at 5 dB | 0.87 | 1.00 | 0.96 | 0.99 | 0.98 | 1.00 |
| `pyin`, at 5 dB | 1.00 | 1.00 | 1.00 | 0.95 | 1.00 | 0.99 |

Without noise and at 20 dB, the preset reaches at least 0.99 in every column. `pyin` also uses the continuity of the
pitch; at 5 dB it is better below 120 Hz and from 180 to 250 Hz, where the preset finds unrelated pitches or the octave
above. Pitches from 60 to 80 Hz are left out because 0.92 of the frames of 24 such vowels are right.

In two recordings of speech and in synthetic voices (espeak-ng de+f2, en+m3), 0.99 or more of the frames that `pyin`
takes as voiced are within 50 cents of it. For espeak-ng es+f1, en+f3 and fr+f4 with pitches of 260 to 280 Hz, 0.50,
0.76 and 0.86 are, and most others are an octave below `pyin` (highest peak, `ac_K` = 2: 0.40, 0.58 and 0.75). The
`roughness` of es+f1 and en+f3 weakens every other period, which makes the octave ambiguous; without it, 0.99 and 1.00
are right. The defaults, which are those of the original, suit pitches above 150 Hz.

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
