"""Learn the model of a head once, for `rosafe localize --head FILE`, from a SOFA file or from recordings.

pair:SPACING, such as pair:0.058, is two microphones with this distance in m and without a head.
RECORDINGS.csv has the columns file, azimuth_deg: sound files with two ears of one source at a known direction each,
left positive. The directions must surround the head, at most 30 degrees apart; several files for one direction are
allowed.

example:
  rosafe head learn /usr/share/libmysofa/default.sofa -o kemar.head
  rosafe localize speech.wav --head kemar.head"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rosafe.commands import CommandError
from rosafe.commands._parameters import add_mirror, add_settings, one_input, parameters_of
from rosafe.system import option_types
from rosafe.system.output import check_target

_RATE = 44100


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe head learn HEAD.sofa|RECORDINGS.csv|pair:SPACING -o FILE [--rate HZ] [--[no-]mirror]\n"
        "                         [--set NAME=VALUE ...] [--force]"
    )
    parser.add_argument("action", type=_action, metavar="learn", help="what to do")
    parser.add_argument(
        "inputs", nargs="*", metavar="SOURCE", help="SOFA file, CSV file with a list of recordings, or pair:SPACING"
    )
    parser.add_argument("-o", "--to", dest="to", metavar="FILE", required=True, help="the model")
    parser.add_argument(
        "--rate",
        type=option_types.whole_number(8000, 768_000),
        metavar="HZ",
        help=f"sample rate of the sounds to localize (default: {_RATE}; that of the recordings)",
    )
    add_mirror(parser)
    add_settings(parser, "rosafe process -h lists them")
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")


def _action(text: str) -> str:
    if text != "learn":
        raise argparse.ArgumentTypeError(f"expected learn, got {text!r}")
    return text


def run(options: argparse.Namespace) -> int:
    """Learn and write the model."""
    source = one_input(options, "SOURCE: expected one SOFA file or one list of recordings")
    target = Path(options.to)
    check_target(target, options.force)
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.localization.head import Head, computed_head
    from rosafe.localization.model_cache import terminal_progress
    from rosafe.localization.recordings import learn_recordings
    from rosafe.localization.training import learn_head

    parameters = parameters_of(options.settings) or None
    progress = terminal_progress(source)
    try:
        if source.lower().endswith(".csv"):
            if options.mirror is not None:
                raise ValueError(f"--mirror: expected a SOFA file, got {source}")
            model = learn_recordings(source, options.rate, parameters, progress)
        else:
            head = None if options.mirror is not None else computed_head(source)
            model = learn_head(
                head or Head.from_sofa(source, options.mirror), float(options.rate or _RATE), parameters, progress
            )
        if progress:
            progress(1.0)
        model.save(target, options.force)
    except (ValueError, AudioFileError) as problem:
        raise CommandError(str(problem)) from None
    print(
        f"{target}: {len(model.azimuths)} directions, {model.channels} channels, {model.sample_rate:g} Hz",
        file=sys.stderr,
    )
    return 0
