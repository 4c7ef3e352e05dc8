"""What the commands that compute have in common: --set NAME=VALUE and --outputs NAME,..."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from rosafe.interface.arguments import check_parameter


class _Settings(argparse.Action):
    """Words after --set: settings as far as they look so, the others are input files."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        words = list(values or ())
        if "=" not in words[0]:
            parser.error(f"--set {words[0]}: wanted is NAME=VALUE")
        namespace.settings = namespace.settings + [word for word in words if "=" in word]
        namespace.more_inputs = namespace.more_inputs + [word for word in words if "=" not in word]


def add_settings(parser: argparse.ArgumentParser, where: str) -> None:
    """Add --set; `where` says where the parameters are described. Input files behind it are in `more_inputs`."""
    parser.add_argument(
        "--set",
        dest="settings",
        nargs="+",
        action=_Settings,
        default=[],
        metavar="NAME=VALUE",
        help=f"change parameters from their defaults; {where}",
    )
    parser.set_defaults(more_inputs=[])


def parameters_of(settings: list[str]) -> dict[str, Any]:
    """The values by name; ValueError for what cannot be, and for a name that is there twice."""
    values: dict[str, Any] = {}
    for setting in settings:
        name, _, text = setting.partition("=")
        name, value = check_parameter(name, text, text=True)
        if name in values:
            raise ValueError(f"{name} is given twice")
        values[name] = value
    return values


def parse_settings(text: str | None) -> list[str] | None:
    """The words between the commas of an option; None where it was not given."""
    return None if text is None else [word.strip() for word in text.split(",")]
