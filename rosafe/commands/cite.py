"""Print a paragraph for a methods section, with the publications of the representations in use.

With a result of `rosafe process` the paragraph contains its version, sample rate and parameters. With --outputs it is
about these representations and their parents. With neither it is about the software only.

examples:
  rosafe cite speech.npz
  rosafe cite --outputs ratemap,ild --set ihc_method=breebart --bibtex"""

from __future__ import annotations

import argparse
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._parameters import add_settings, load_result, parameters_of, parse_settings


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = "rosafe cite [RESULT] [--outputs NAME,... [--set NAME=VALUE ...]] [--bibtex]"
    parser.add_argument("results", nargs="*", metavar="RESULT", help="result of rosafe process")
    parser.add_argument("--outputs", metavar="NAME,...", help="representations, instead of those of a result")
    add_settings(parser, "rosafe process -h lists them; with --outputs only")
    parser.add_argument("--bibtex", action="store_true", help="print the publications as BibTeX entries")


def run(options: argparse.Namespace) -> int:
    """Print the paragraph, or the BibTeX entries."""
    results = [*options.results, *options.more_inputs]
    if len(results) > 1:
        options.usage_error(f"RESULT: expected at most one result, got {len(results)}")
    if results and (options.outputs or options.settings):
        options.usage_error("--outputs, --set: expected no result, got one: a result already has its representations")
    if options.settings and not options.outputs:
        options.usage_error("--set: expected --outputs as well, got none")
    from rosafe.interface import KINDS, citing
    from rosafe.interface.arguments import needed

    try:
        names, known = _of_result(results[0]) if results else _of_options(options)
    except ValueError as problem:
        raise CommandError(str(problem)) from None
    kinds = [KINDS[name] for name in needed(names)] if names else []
    if options.bibtex:
        publications = citing.references(kinds, known["parameters"])
        print(citing.bibtex([citing.software(known["version"]), *publications]), end="")
    else:
        print(citing.paragraph(kinds, **known), end="")
    return 0


def _of_result(path: str) -> tuple[list[str], dict[str, Any]]:
    result = load_result(path)
    return result.kinds, {
        "parameters": result.parameters,
        "sample_rate": result.sample_rate,
        "version": result.version,
    }


def _of_options(options: argparse.Namespace) -> tuple[list[str], dict[str, Any]]:
    from rosafe.interface import KINDS
    from rosafe.interface.arguments import check_outputs
    from rosafe.system.version import VERSION

    names = parse_settings(options.outputs)
    values = {p.name: p.default for kind in KINDS.values() for p in kind.parameters if not p.follows_rate}
    values |= parameters_of(options.settings)
    return check_outputs(names) if names else [], {"parameters": values, "version": VERSION}
