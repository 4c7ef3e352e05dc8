"""Read scenes from YAML files; docs/scenes.md describes the format."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from typing import Any

from rosafe.audio.files.audiofile import AudioFileError
from rosafe.declarations.text import short_repr
from rosafe.localization.head import Head, computed_head
from rosafe.localization.rectangular_room import (
    MAX_DRR,
    MAX_RT60,
    MAX_SIDE,
    MIN_DRR,
    MIN_RT60,
    MIN_SIDE,
    RectangularRoom,
)
from rosafe.localization.scene import DEFAULT_DISTANCE, Course, SceneDescription, SourceDescription
from rosafe.localization.scene_signals import (
    MAX_FILE_FRAMES,
    FileSignal,
    NoiseSignal,
    SourceSignal,
    ToneSignal,
    VowelSignal,
)
from rosafe.system.input import read_regular
from rosafe.system.terminal import printable
from rosafe.tree.setups.markup import SetupError, YamlNode, parse

SUFFIXES = (".yaml", ".yml")
MAX_BYTES = 1 << 18
MAX_VALUES = 45_000  # 10,000 points have 40,000
MAX_SOURCES = 32
MAX_POINTS = 10_000
MAX_DURATION = 86_400.0  # s
MIN_DISTANCE, MAX_DISTANCE = 0.2, 30.0  # m
MIN_RATE, MAX_RATE = 8000, 192_000  # Hz
DEFAULT_RATE = 44100
DEFAULT_LEVEL_DB = -30.0
_SIGNALS = ("noise", "tone", "vowel")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,63}")
_SCENE = ("sample_rate", "duration", "seed", "head", "head_yaw", "noise", "room", "sources")
_SOURCE = ("name", "file", "signal", "frequency", "loop", "level_db", "azimuth", "distance", "start", "end")


class SceneError(ValueError):
    """The scene cannot be used; the text is one line that names the file."""


def read_scene(path: str | os.PathLike[str], sample_rate: int = 0) -> SceneDescription:
    """Read a scene.

    Parameters
    ----------
    path : str or Path
        A file whose name ends in .yaml or .yml. Relative paths in it are relative to its folder.
    sample_rate : int
        Required sample rate, Hz; 0 takes that of the scene.

    Raises
    ------
    SceneError
        The file, or a file that it names, cannot be used.
    SampleRateError
        The scene has another sample rate.
    """
    name = os.path.expanduser(os.fspath(path))
    shown = printable(name)
    if not name.lower().endswith(SUFFIXES):
        raise SceneError(f"{shown}: expected a name that ends in {' or '.join(SUFFIXES)}")
    try:
        data = read_regular(name, MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise SceneError(f"expected at most {MAX_BYTES} bytes")
        text = data.decode("utf-8")
        return _SceneReader(os.path.dirname(name), sample_rate).scene(parse(text, MAX_VALUES))
    except SampleRateError as problem:
        raise SampleRateError(f"{shown}: {problem}") from None
    except UnicodeDecodeError:
        raise SceneError(f"{shown}: expected UTF-8 text") from None
    except OSError as problem:
        raise SceneError(f"{shown}: {problem.strerror or problem}") from None
    except (ValueError, AudioFileError) as problem:
        raise SceneError(f"{shown}: {problem}") from None


class SampleRateError(SceneError):
    """The scene has another sample rate than the caller needs."""


class _SceneReader:
    """Checks the values of one scene and opens its files."""

    def __init__(self, folder: str, sample_rate: int) -> None:
        self._folder = folder
        self._wanted = sample_rate
        self._rate = DEFAULT_RATE
        self._seed = 0
        self._frames = 0  # of all sound files

    def scene(self, document: YamlNode) -> SceneDescription:
        values = {name: node for name, _, node in document.members("a scene", _SCENE)}

        def value(name: str, convert: Callable[[YamlNode, str], Any], default: Any) -> Any:
            return convert(values[name], name) if name in values and not values[name].empty else default

        self._rate = value("sample_rate", _number(MIN_RATE, MAX_RATE, whole=True), DEFAULT_RATE)
        if self._wanted not in (0, self._rate):
            raise SampleRateError(f"sample_rate: expected {self._wanted} Hz, got {self._rate} Hz; 0 takes the scene's")
        self._seed = value("seed", _number(0, 2**53, whole=True), 0)
        sources = values.get("sources", YamlNode(document.line))
        if sources.items is None or not 0 < len(sources.items) <= MAX_SOURCES:
            raise SetupError(sources.line, f"sources: expected a list of 1 to {MAX_SOURCES} sources")
        return SceneDescription(
            sample_rate=self._rate,
            duration=value("duration", _number(0.001, MAX_DURATION), None),
            seed=self._seed,
            head=value("head", self._head, None) or Head.sphere(),
            head_yaw=value("head_yaw", _course, Course()),
            snr_db=value("noise", _noise, None),
            room=value("room", self._room, None),
            sources=self._sources(sources.items),
        )

    def _path(self, node: YamlNode, what: str) -> str:
        text = node.scalar(what)
        if not text or "\0" in text:
            raise SetupError(node.line, f"{what}: expected the path of a file, got {short_repr(text)}")
        return os.path.join(self._folder, os.path.expanduser(text))

    def _head(self, node: YamlNode, what: str) -> Head:
        mirror = None
        if node.pairs is not None:
            values = {name: value for name, _, value in node.members(what, ("file", "mirror"))}
            mirror = _flag(values["mirror"], f"{what}: mirror") if "mirror" in values else None
            node, what = values.get("file", YamlNode(node.line)), f"{what}: file"
        try:
            if (computed := computed_head(node.scalar(what))) is not None:
                return computed
        except ValueError as problem:
            raise SetupError(node.line, str(problem)) from None
        path = self._path(node, what)
        if not path.lower().endswith(".sofa"):
            raise SetupError(node.line, f"{what}: expected 'sphere', 'pair:SPACING' or a file that ends in .sofa")
        return Head.from_sofa(path, mirror)

    def _room(self, node: YamlNode, what: str) -> RectangularRoom:
        values = {name: value for name, _, value in node.members(what, ("size", "rt60", "drr_db"))}
        if "rt60" not in values or ("size" in values) == ("drr_db" in values):
            raise SetupError(
                node.line, f"{what}: expected rt60, and either size or drr_db, got {short_repr([*values])}"
            )
        rt60 = _number(MIN_RT60, MAX_RT60)(values["rt60"], f"{what}: rt60")
        if "drr_db" in values:
            return RectangularRoom.drawn(
                rt60, _number(MIN_DRR, MAX_DRR)(values["drr_db"], f"{what}: drr_db"), self._seed
            )
        size = values["size"].items or (values["size"],)
        sides = tuple(_number(MIN_SIDE, MAX_SIDE)(side, f"{what}: size") for side in size)
        try:
            return RectangularRoom(sides, rt60)
        except ValueError as problem:
            raise SetupError(node.line, f"{what}: {problem}") from None

    def _sources(self, nodes: tuple[YamlNode, ...]) -> tuple[SourceDescription, ...]:
        sources: dict[str, SourceDescription] = {}
        for number, node in enumerate(nodes):
            source = self._source(node, number)
            if source.name in sources:
                raise SetupError(node.line, f"sources: the name {short_repr(source.name)} occurs twice")
            sources[source.name] = source
        return tuple(sources.values())

    def _source(self, node: YamlNode, number: int) -> SourceDescription:
        what = f"source {number + 1}"
        values = {name: value for name, _, value in node.members(what, _SOURCE)}

        def value(name: str, convert: Callable[[YamlNode, str], Any], default: Any) -> Any:
            found = values.get(name)
            return default if found is None or found.empty else convert(found, f"{what}: {name}")

        name = value("name", YamlNode.scalar, f"source{number + 1}")
        if not _NAME.fullmatch(name):
            raise SetupError(
                node.line, f"{what}: name: expected letters, digits, _ . - and blanks, got {short_repr(name)}"
            )
        start = value("start", _number(0, MAX_DURATION), 0.0)
        end = value("end", _number(0, MAX_DURATION), math.inf)
        if end <= start:
            raise SetupError(node.line, f"{what}: end: expected more than start ({start:g} s), got {end:g}")
        frequency = value("frequency", _number(20, 0.45 * self._rate), None)
        return SourceDescription(
            name=name,
            signal=self._signal(node.line, what, values, frequency, value("loop", _flag, False), number),
            azimuth=value("azimuth", _course, Course()),
            level_db=value("level_db", _number(-120, 0), DEFAULT_LEVEL_DB),
            start=start,
            end=end,
            distance=value("distance", _number(MIN_DISTANCE, MAX_DISTANCE), DEFAULT_DISTANCE),
        )

    def _signal(
        self, line: int, what: str, values: dict[str, YamlNode], frequency: float | None, loop: bool, number: int
    ) -> SourceSignal:
        if ("file" in values) == ("signal" in values):
            raise SetupError(line, f"{what}: expected either file or signal ({', '.join(_SIGNALS)})")
        if "file" in values:
            signal = FileSignal(self._path(values["file"], f"{what}: file"), self._rate, loop)
            self._frames += signal.stored
            if self._frames > MAX_FILE_FRAMES:
                raise SetupError(line, f"sources: expected sound files of at most {MAX_FILE_FRAMES} frames together")
            return signal
        kind = values["signal"].scalar(f"{what}: signal")
        if kind == "noise":
            return NoiseSignal(self._rate, self._seed, number)
        if kind == "tone":
            return ToneSignal(self._rate, frequency or 500.0)
        if kind == "vowel":
            return VowelSignal(self._rate, frequency or 120.0)
        raise SetupError(line, f"{what}: signal: expected one of {', '.join(_SIGNALS)}, got {short_repr(kind)}")


# --- values -----------------------------------------------------------------------------------------------------


def _number(low: float, high: float, whole: bool = False) -> Callable[[YamlNode, str], Any]:
    """Return a converter to a number from `low` to `high`."""

    def convert(node: YamlNode, what: str) -> float:
        text = node.scalar(what)
        try:
            number: float = int(text) if whole else float(text)
        except ValueError:
            number = math.nan
        if not low <= number <= high:
            kind = "a whole number" if whole else "a number"
            raise SetupError(node.line, f"{what}: expected {kind} from {low:g} to {high:g}, got {short_repr(text)}")
        return number

    return convert


def _flag(node: YamlNode, what: str) -> bool:
    text = node.scalar(what).lower()
    if text not in ("true", "false"):
        raise SetupError(node.line, f"{what}: expected true or false, got {short_repr(text)}")
    return text == "true"


_ANGLE = _number(-36_000, 36_000)
_TIME = _number(0, MAX_DURATION)


def _course(node: YamlNode, what: str) -> Course:
    """Return a number of degrees, or a list of [time in s, degrees]."""
    if node.items is None:
        return Course((0.0,), (_ANGLE(node, what),))
    if not 0 < len(node.items) <= MAX_POINTS:
        raise SetupError(node.line, f"{what}: expected 1 to {MAX_POINTS} points, got {len(node.items)}")
    points = []
    for item in node.items:
        if item.items is None or len(item.items) != 2:
            raise SetupError(item.line, f"{what}: expected [time in s, degrees]")
        points.append((_TIME(item.items[0], what), _ANGLE(item.items[1], what)))
        if len(points) > 1 and points[-1][0] < points[-2][0]:
            raise SetupError(item.line, f"{what}: expected ascending times")
    times, values = zip(*points, strict=True)
    return Course(times, values)


def _noise(node: YamlNode, what: str) -> float:
    values = {name: value for name, _, value in node.members(what, ("snr_db",))}
    if "snr_db" not in values:
        raise SetupError(node.line, f"{what}: expected snr_db")
    return float(_number(-60, 120)(values["snr_db"], f"{what}: snr_db"))
