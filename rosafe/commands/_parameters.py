"""Options shared by the commands that compute: --set NAME=VALUE and --outputs NAME,..."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosafe.interface.arguments import check_parameter
from rosafe.interface.remarks import PRESETS

if TYPE_CHECKING:
    from rosafe.results.result import Result


class _Settings(argparse.Action):
    """Arguments after --set: those with an equals sign are settings, the others are input files."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        words = list(values or ())
        if "=" not in words[0]:
            parser.error(f"--set: expected NAME=VALUE, got {words[0]!r}")
        namespace.settings = namespace.settings + [word for word in words if "=" in word]
        namespace.more_inputs = namespace.more_inputs + [word for word in words if "=" not in word]


def add_settings(parser: argparse.ArgumentParser, where: str) -> None:
    """Add --set. `where` says where the parameters are described. Input files after it are put in `more_inputs`."""
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


def add_mirror(parser: argparse.ArgumentParser) -> None:
    """Add --mirror and --no-mirror."""
    parser.add_argument(
        "--mirror",
        action=argparse.BooleanOptionalAction,
        help="whether the labels of a SOFA file exchange left and right (default: decided by the levels at the ears)",
    )


def add_head(parser: argparse.ArgumentParser) -> None:
    """Add --head, --mirror and --no-mirror."""
    parser.add_argument(
        "--head",
        metavar="FILE",
        help="SOFA file, a model that `rosafe head learn` has written, or pair:SPACING, two microphones without a head "
        "and their distance in m (default: a sphere); sphere and pair cannot distinguish front from back",
    )
    add_mirror(parser)


def head_of(options: argparse.Namespace) -> Any:
    """Return the head of --head and --mirror for `rosafe.localize`; ValueError if they do not fit together."""
    head, mirror = options.head or "sphere", options.mirror
    if mirror is None:
        return head
    if not head.lower().endswith(".sofa"):
        raise ValueError(f"--mirror: expected a SOFA file as the head, got {head}")
    from rosafe.localization.head import Head

    return Head.from_sofa(head, mirror)


def add_channels(parser: argparse.ArgumentParser) -> None:
    """Add --channels."""
    text = "the channels (from 1) that are the left and the right ear; 1,1 for mono (default: 1,2 of two)"
    parser.add_argument("--channels", type=_ear_channels, metavar="L,R", help=text)


def _ear_channels(text: str) -> tuple[int, int]:
    """Convert the value of --channels, such as ``3,4``."""
    from rosafe.audio.files.audiofile import channel_pair

    try:
        return channel_pair(text)
    except ValueError as problem:
        raise argparse.ArgumentTypeError(str(problem)) from None


def add_preset(parser: argparse.ArgumentParser) -> None:
    """Add --preset."""
    parser.add_argument(
        "--preset",
        choices=sorted(PRESETS),
        help="parameters for a purpose, which --set can change: "
        + "; ".join(f"{name}: {_as_settings(values)}" for name, values in PRESETS.items()),
    )


def _as_settings(values: dict[str, Any]) -> str:
    return " ".join(f"{name}={value}" for name, value in values.items())


def add_float_handling(parser: argparse.ArgumentParser) -> None:
    """Add --no-clip."""
    parser.add_argument(
        "--no-clip",
        action="store_true",
        help="process the samples of float files as they are; by default those beyond full scale are clipped, as by "
        "the node",
    )


def clipping_warning(count: int) -> str:
    """Return the message about clipped samples."""
    return f"{count} samples beyond full scale were clipped, as by the node; --no-clip processes them as they are"


def parameters_of(settings: list[str], preset: str | None = None) -> dict[str, Any]:
    """Return the values by name. Raises ValueError for invalid settings and for a name that occurs twice."""
    values: dict[str, Any] = {}
    for setting in settings:
        name, _, text = setting.partition("=")
        name, value = check_parameter(name, text, text=True)
        if name in values:
            raise ValueError(f"{name}: expected one value, got two")
        values[name] = value
    return {**PRESETS[preset], **values} if preset else values


def load_result(path: str | Path) -> Result:
    """Return the result in a file as `rosafe.load`; ValueError also if the file cannot be opened."""
    from rosafe.results.readers import load

    try:
        return load(path)
    except OSError as problem:
        raise ValueError(f"{path}: {problem.strerror}") from None


def one_input(options: argparse.Namespace, what: str) -> str:
    """Return the only input of a command, or exit with a usage error."""
    inputs = [*options.inputs, *options.more_inputs]
    if len(inputs) != 1:
        options.usage_error(f"{what}, got {len(inputs)}")
    return str(inputs[0])


def parse_settings(text: str | None) -> list[str] | None:
    """Return the names between the commas of an option, or None if the option was not given."""
    return None if text is None else [word.strip() for word in text.split(",")]
