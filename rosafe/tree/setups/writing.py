"""Write a setup as readable YAML, from which `read` returns exactly the same setup."""

from __future__ import annotations

from typing import Any

import yaml

from .setup import Setup, SetupProcessor

_HEAD = "# A setup of rosAFE; load it with `rosafe setup load FILE`."


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """Writes one line for each item of a map, and lists in brackets."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


def _list(dumper: _Dumper, values: list[Any]) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=True)


_Dumper.add_representer(list, _list)


def write(setup: Setup, full: bool = False) -> str:
    """Return the YAML text of a setup; with `full`, parameters at their defaults are included.

    Numbers are written as by Python, with the digits that are necessary to read the same number.
    """
    sections: dict[str, Any] = {}
    if setup.sound is not None:
        explicit = setup.sound.explicit
        sections["sound"] = {
            name: value for name, value in setup.sound.values.items() if full or name == "device" or name in explicit
        }
    if setup.connections:
        sections["connections"] = dict(setup.connections)
    if setup.processors:
        sections["processors"] = {processor.name: _members(processor, full) for processor in setup.processors}
    if setup.localizer is not None:
        sections["localizer"] = dict(setup.localizer)
    head = _HEAD if full else f"{_HEAD} Omitted parameters have their defaults."
    return f"{head}\n" + "".join(
        "\n" + yaml.dump({name: section}, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
        for name, section in sections.items()
    )


def _members(processor: SetupProcessor, full: bool) -> dict[str, Any]:
    values = processor.all_values if full else processor.explicit
    parent = {"parent": processor.parent} if processor.parent else {}
    return {
        "kind": processor.kind,
        **parent,
        **{p.name: values[p.name] for p in processor.parameters if p.name in values},
    }
