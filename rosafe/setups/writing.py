"""From a setup to the text that `read` takes: as a person would write it, and true to the last digit."""

from __future__ import annotations

from typing import Any

import yaml

from .setup import Setup, SetupProcessor

_HEAD = "# A setup of rosAFE: `rosafe setup load FILE` builds it. What is not given has its default.\n"
_HEAD_FULL = "# A setup of rosAFE: `rosafe setup load FILE` builds it.\n"


class _Dumper(yaml.SafeDumper):
    """Maps in lines of their own, lists in brackets."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


def _list(dumper: _Dumper, values: list[Any]) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=True)


_Dumper.add_representer(list, _list)


def write(setup: Setup, full: bool = False) -> str:
    """The YAML text of a setup; with `full`, what has its default too.

    Numbers are written as Python does, with as many digits as it takes to read the same number.
    """
    sections: dict[str, Any] = {}
    if setup.sound is not None:
        given, values = setup.sound.given, setup.sound.values
        sections["sound"] = {n: value for n, value in values.items() if full or n == "device" or n in given}
    if setup.connections:
        sections["connections"] = dict(setup.connections)
    if setup.processors:
        sections["processors"] = {wanted.name: _processor(wanted, full) for wanted in setup.processors}
    head = _HEAD_FULL if full else _HEAD
    return head + "".join(
        "\n" + yaml.dump({name: section}, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
        for name, section in sections.items()
    )


def _processor(wanted: SetupProcessor, full: bool) -> dict[str, Any]:
    values = wanted.all_values if full else wanted.given
    parent = {"parent": wanted.parent} if wanted.parent else {}
    return {
        "kind": wanted.kind,
        **parent,
        **{p.name: values[p.name] for p in wanted.parameters if p.name in values},
    }
