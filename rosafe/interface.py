"""The one table of the component interface: requests, parameters, types, exceptions and ports of `rosAFE` and `bass`.

The nodes, the HTTP server, the Tcl help, the documentation and the test that compares the .msg, .srv and .action
files all read this table; nothing else states a parameter's name, type, default, range or order.
It imports nothing but the standard library.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

# --- errors -----------------------------------------------------------------------------------------------------


class ComponentError(Exception):
    """A named exception of the interface, as it goes over the wire.

    Parameters
    ----------
    ex : str
        Full identifier, such as ``::rosAFE::e_noData`` or ``::genom::no_such_inport``.
    why : str, optional
        One line for people (logs, stderr). It crosses the wire only where the exception has a member for it.
    **detail
        The exception's members, such as ``what`` of ``::rosAFE::e_badNewValue``.
    """

    def __init__(self, ex: str, why: str = "", **detail: Any) -> None:
        super().__init__(why or detail.get("what") or ex)
        self.ex = ex
        self.why = why
        self.detail = detail

    @property
    def exdetail(self) -> str:
        """The JSON text for `genom_exdetail`: no spaces, `detail` only where there are members."""
        body: dict[str, Any] = {"ex": self.ex}
        if self.detail:
            body["detail"] = self.detail
        text = json.dumps(body, separators=(",", ":"), ensure_ascii=False)
        # Half a surrogate pair has no UTF-8; as an escape it is valid JSON.
        return text.encode("utf-8", "backslashreplace").decode()


# --- vocabulary -------------------------------------------------------------------------------------------------

REQUIRED = object()  # a parameter without a default, such as connect_port's `local`

ROS_TYPES = {
    "boolean": "bool",
    "unsigned short": "uint16",
    "short": "int16",
    "unsigned long": "uint32",
    "long": "int32",
    "unsigned long long": "uint64",
    "long long": "int64",
    "float": "float32",
    "double": "float64",
    "char": "int8",
    "octet": "uint8",
    "string": "string",
}
_INTEGER_BOUNDS = {
    "unsigned short": (0, 2**16 - 1),
    "short": (-(2**15), 2**15 - 1),
    "unsigned long": (0, 2**32 - 1),
    "long": (-(2**31), 2**31 - 1),
    "unsigned long long": (0, 2**64 - 1),
    "long long": (-(2**63), 2**63 - 1),
    "char": (-(2**7), 2**7 - 1),
    "octet": (0, 2**8 - 1),
}


def ros_type(idl: str) -> str:
    """The ROS field type of an IDL type: ``unsigned long`` is ``uint32``, ``sequence<double>`` is ``float64[]``."""
    if idl.startswith("sequence<"):
        return ros_type(idl[len("sequence<") : -1]) + "[]"
    if idl.startswith("::"):
        return idl[2:].replace("::", "_")
    return ROS_TYPES[idl]


def _plain(value: Any) -> Any:
    """A number of numpy's, or an array without dimensions, as Python's own type."""
    return value.item() if hasattr(value, "item") and getattr(value, "ndim", 1) == 0 else value


@dataclass(frozen=True)
class Parameter:
    """One member of a request, or one parameter of a processor.

    `minimum` and `maximum` are inclusive unless `open_minimum` says otherwise; they bind the elements of a sequence.
    `choices` are the known words of an enumerated string; the node reads any other word as `fallback`.
    """

    name: str
    idl: str
    default: Any
    doc: str
    minimum: float | None = None
    maximum: float | None = None
    open_minimum: bool = False
    choices: tuple[str, ...] = ()
    fallback: str = ""
    aliases: tuple[str, ...] = ()
    zero_is_default: bool = True  # in ROS requests, which carry no defaults

    @property
    def ros(self) -> str:
        return ros_type(self.idl)

    @property
    def range_text(self) -> str:
        """The range in words, for help texts and error messages; empty where anything goes."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        low, high = self.minimum, self.maximum
        if low is None and high is None:
            return ""
        if high is None:
            return f"{'more than' if self.open_minimum else 'at least'} {low:.12g}"
        if low is None:
            return f"at most {high:.12g}"
        return f"{'more than' if self.open_minimum else 'from'} {low:.12g} to {high:.12g}"

    def check(self, value: Any) -> Any:
        """`value` as this parameter's Python type, or ValueError naming the parameter and what is allowed.

        Every value is taken literally; words are only checked for being words (see `known_word`).
        """
        if self.idl.startswith("sequence<"):
            return self._check_sequence(value)
        return self._check_scalar(self.idl, value)

    def _refuse(self, value: Any, wanted: str) -> ValueError:
        shown = repr(value)
        return ValueError(f"{self.name}: {shown if len(shown) <= 80 else shown[:77] + '...'} is not {wanted}")

    def _check_sequence(self, value: Any) -> list[Any]:
        element = self.idl[len("sequence<") : -1]
        if value is None:
            return []
        if isinstance(value, (str, bytes, Mapping)):
            raise self._refuse(value, f"a list of {element}")
        try:
            items = [_plain(item) for item in itertools.islice(value, MAX_SEQUENCE + 1)]
        except TypeError:  # a single number is a list of one: MATLAB users write 0 for "no list"
            items = [_plain(value)]
        if len(items) > MAX_SEQUENCE:
            raise ValueError(f"{self.name}: too many values, at most {MAX_SEQUENCE}")
        if len(items) == 1 and isinstance(items[0], (int, float)) and items[0] == 0:  # [0] is "no list" likewise
            return []
        return [self._check_scalar(element, item) for item in items]

    def _check_scalar(self, idl: str, value: Any) -> Any:
        if idl == "string":
            if not isinstance(value, str):
                raise self._refuse(value, "a string")
            if len(value) > MAX_STRING or "\0" in value:
                raise self._refuse(value, f"a text of at most {MAX_STRING} characters")
            return value
        value = _plain(value)
        if idl == "boolean":
            if isinstance(value, (bool, int, float)) and value in (0, 1):
                return bool(value)
            raise self._refuse(value, "a boolean")
        try:
            number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
        except OverflowError:
            number = math.nan
        if not math.isfinite(number):
            raise self._refuse(value, "a finite number")
        if idl in _INTEGER_BOUNDS:
            if number != int(number):
                raise self._refuse(value, "a whole number")
            whole = int(value)
            low, high = _INTEGER_BOUNDS[idl]
            if not low <= whole <= high:
                raise self._refuse(value, f"in the range of {idl}")
            self._check_range(whole)
            return whole
        self._check_range(number)
        return number

    def _check_range(self, number: float) -> None:
        low, high = self.minimum, self.maximum
        below = low is not None and (number < low or (self.open_minimum and number == low))
        if below or (high is not None and number > high):
            raise ValueError(f"{self.name}: {number:.12g} is out of range, allowed is {self.range_text}")

    def parse(self, text: str) -> Any:
        """The value that `text` says, by modifyParameter's rules, checked.

        Booleans: 0, 1, true, false (blanks around are fine). Numbers: decimal or with exponent; no inf, nan or hex.
        Unsigned: digits only. Lists: numbers between blanks, commas, brackets or braces.
        """
        words = text.strip()
        if self.idl == "string":
            return self.check(words)
        if self.idl == "boolean":
            known = {"0": False, "1": True, "true": True, "false": False}
            if words not in known:
                raise self._refuse(text, "a boolean: 0, 1, true or false")
            return known[words]
        if self.idl in _INTEGER_BOUNDS:
            digits = words[1:] if words[:1] in "+-" and words[:1] else words
            if not (digits.isascii() and digits.isdigit()):
                raise self._refuse(text, f"a whole number ({self.idl})")
            if len(digits) > 30:
                raise self._refuse(text, f"in the range of {self.idl}")
            return self.check(int(words))
        if self.idl.startswith("sequence<"):
            for mark in "[]{}(),;":
                words = words.replace(mark, " ")
            return self.check([self._parse_number(word) for word in words.split()])
        return self.check(self._parse_number(words))

    def _parse_number(self, word: str) -> float:
        if not word or any(c not in "0123456789+-.eE" for c in word):
            raise self._refuse(word, "a number")
        try:
            return float(word)
        except ValueError:
            raise self._refuse(word, "a number") from None

    def known_word(self, value: str) -> str:
        """The word in force for `value`: itself where it is known, else the fallback (`jespen` becomes `jepsen`)."""
        if not self.choices or value in self.choices:
            return value
        return self.fallback or str(self.default)


MAX_STRING = 4096  # characters in any string that a request carries
MAX_SEQUENCE = 1024  # elements in any list that a request carries, and channels of a filterbank


@dataclass(frozen=True)
class Service:
    """One request of a component.

    `activity` requests live until they end or are stopped and have an action beside the service; the others are
    functions that answer at once. `interrupts` names the activity of which running instances end when this begins.
    """

    name: str
    doc: str
    parameters: tuple[Parameter, ...] = ()
    outputs: tuple[tuple[str, str], ...] = ()  # (name, IDL type)
    throws: tuple[str, ...] = ()
    activity: bool = False
    task: str = ""
    interrupts: tuple[str, ...] = ()
    aliases: tuple[str, ...] = ()

    def parameter(self, name: str) -> Parameter:
        """The parameter called `name` (aliases count), or KeyError."""
        for parameter in self.parameters:
            if name == parameter.name or name in parameter.aliases:
                return parameter
        raise KeyError(name)

    def from_ros(self, request: Any) -> dict[str, Any]:
        """The values of a ROS request or goal, not yet checked; 0, "" and [] there stand for the default."""
        values = {}
        for parameter in self.parameters:
            value = getattr(request, parameter.name)
            unset = not isinstance(value, bool) and (
                len(value) == 0 if hasattr(value, "__len__") else value == 0  # "" and [] have a length
            )
            if unset and parameter.zero_is_default and parameter.default is not REQUIRED:
                value = parameter.default
            values[parameter.name] = value
        return values

    def check(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """All values as their parameters' Python types, or ValueError naming the first that is refused."""
        return {parameter.name: parameter.check(values[parameter.name]) for parameter in self.parameters}


@dataclass(frozen=True)
class Port:
    """A data port: one topic, or one topic per element where `multiple`."""

    name: str
    idl: str
    doc: str
    output: bool = True
    multiple: bool = False
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProcessorKind:
    """One type of processor of the rosAFE tree."""

    kind: str  # also the name of its array in getParameters and getSignals
    request: str
    parent: str  # the kind of processor it can hang on; empty for the input
    port: str
    parameters: tuple[Parameter, ...]  # in the order of the parameter structure
    representation: str  # what the original's MATLAB client calls it, and its processors (`ild_0`)
    rename: Mapping[str, str] = field(default_factory=dict)  # names that modifyParameter accepts besides the real ones

    def parameter(self, name: str) -> Parameter:
        """The parameter that modifyParameter calls `name`, or KeyError."""
        real = self.rename.get(name, name)
        for parameter in self.parameters:
            if real == parameter.name or real in parameter.aliases:
                return parameter
        raise KeyError(name)


@dataclass(frozen=True)
class Component:
    """The interface of one component (ROS package)."""

    name: str
    doc: str
    services: tuple[Service, ...]
    ports: tuple[Port, ...]
    tasks: tuple[str, ...]
    exceptions: Mapping[str, str]  # short name -> meaning
    structs: Mapping[str, tuple[tuple[str, str], ...]]  # IDL name -> (field, IDL type)
    # What genomixd makes of several services, for its clients to call like one; not on the ROS graph.
    composites: tuple[Service, ...] = ()

    def service(self, name: str) -> Service:
        """The service called `name` (aliases count), or KeyError."""
        for service in self.services:
            if name == service.name or name in service.aliases:
                return service
        raise KeyError(name)

    def port(self, name: str) -> Port:
        """The port called `name` (aliases count), or KeyError."""
        for port in self.ports:
            if name == port.name or name in port.aliases:
                return port
        raise KeyError(name)

    @property
    def activities(self) -> tuple[Service, ...]:
        return tuple(s for s in self.services if s.activity)

    @property
    def functions(self) -> tuple[Service, ...]:
        return tuple(s for s in self.services if not s.activity)

    def error(self, short: str, why: str = "", **detail: Any) -> ComponentError:
        """The component's exception `short`, such as ``e_noData``."""
        if short not in self.exceptions:
            raise KeyError(short)
        return ComponentError(f"::{self.name}::{short}", why, **detail)


# --- what every component has -----------------------------------------------------------------------------------

GENOM_EXCEPTIONS: dict[str, tuple[tuple[str, str], ...]] = {
    "incompatible_digest": (("client", "::genom::version"), ("server", "::genom::version")),
    "bad_transition": (("from", "string"), ("to", "string")),
    "interrupted": (("by", "string"),),
    "serialization": (),
    "too_many_activities": (),
    "disallowed": (),
    "no_such_inport": (),
    "no_such_outport": (),
    "port_io": (),
    "no_such_remote": (),
    "no_such_service": (),
    "remote_io": (),
    "no_such_activity": (),
    "fatal": (),
    "mwerr": (("what", "string"),),
    "unkex": (("what", "string"),),
    "syserr": (("code", "long"),),
}

MAX_ACTIVITIES = 256  # per task, its permanent one included; the original takes 32

_PORT_NAMES = (
    Parameter("local", "string", REQUIRED, "Name of this component's input port"),
    Parameter("remote", "string", REQUIRED, "Name of the topic to read, such as bass/Audio"),
)
COMMON_SERVICES = (
    Service(
        "connect_port",
        "Connect an input port to another component's output port",
        _PORT_NAMES,
        throws=("::genom::no_such_inport", "::genom::no_such_outport", "::genom::port_io"),
    ),
    Service(
        "connect_service",
        "Connect a remote service",
        (
            Parameter("local", "string", REQUIRED, "Name of this component's remote"),
            Parameter("remote", "string", REQUIRED, "Name of the service to use"),
        ),
        throws=("::genom::no_such_remote", "::genom::no_such_service", "::genom::remote_io"),
    ),
    Service(
        "abort_activity",
        "End one activity",
        (Parameter("activity", "unsigned long", REQUIRED, "Number of the activity, as genom_state shows it"),),
        throws=("::genom::no_such_activity",),
    ),
    Service("kill", "End all activities and the component"),
)

_GENOM_STATE = {
    "::genom_state::stats": (("last", "float"), ("max", "float"), ("avg", "float")),
    "::genom_state::rusage": (
        ("cycles", "unsigned long"),
        ("timings", "::genom_state::stats"),
        ("load", "::genom_state::stats"),
    ),
    "::genom_state::activity": (("id", "unsigned long"), ("name", "string")),
    "::genom_state::task": (
        ("name", "string"),
        ("rusage", "::genom_state::rusage"),
        ("activity", "sequence<::genom_state::activity>"),
    ),
    "::genom_state::component": (
        ("task", "sequence<::genom_state::task>"),
        ("digest", "string"),
        ("date", "string"),
        ("version", "string"),
    ),
}
_BINAUDIO = {
    "::binaudio::timestamp": (("sec", "unsigned long"), ("nsec", "unsigned long")),
    "::binaudio::portStruct": (
        ("sampleRate", "unsigned long"),
        ("nChunksOnPort", "unsigned long"),
        ("nFramesPerChunk", "unsigned long"),
        ("lastFrameIndex", "unsigned long long"),
        ("left", "sequence<long>"),
        ("right", "sequence<long>"),
        ("stamp", "::binaudio::timestamp"),
    ),
}
GENOM_STATE_PORT = Port("genom_state", "::genom_state::component", "Tasks and live activities of the component")

# --- rosAFE: parameters -----------------------------------------------------------------------------------------

MAX_SECONDS = 600.0  # longest port or history
MAX_FRAME_SECONDS = 60.0  # longest analysis window, and longest step from one to the next
MAX_BLOCK = 10_000_000  # frames

_WINDOWS = ("hamming", "hanning", "hann", "blackman", "triang", "sqrt_win")


def _name(default: str, doc: str) -> Parameter:
    return Parameter("name", "string", default, doc)


def _upper(default: str) -> Parameter:
    return Parameter("upperDepName", "string", default, "The name of the upper dependency")


def _window(prefix: str) -> Parameter:
    return Parameter(f"{prefix}_wname", "string", "hann", "Window name", choices=_WINDOWS, fallback="hann")


def _window_size(prefix: str) -> Parameter:
    return Parameter(f"{prefix}_wSizeSec", "double", 0.02, "Window duration (s)", 0.0, MAX_FRAME_SECONDS, True)


def _hop_size(prefix: str) -> Parameter:
    return Parameter(f"{prefix}_hSizeSec", "double", 0.01, "Window step size (s)", 0.0, MAX_FRAME_SECONDS, True)


INPUT_PARAMETERS = (
    Parameter("in_doNormalize", "boolean", True, "Flag to divide the samples by in_normalizeValue"),
    Parameter("in_normalizeValue", "unsigned long long", 2**31 - 1, "Sample value that becomes 1.0", 1, 2**64 - 1),
)
PREPROC_PARAMETERS = (
    Parameter("pp_bRemoveDC", "boolean", False, "Flag to activate the DC-removal high-pass filter"),
    Parameter("pp_cutoffHzDC", "double", 20.0, "Cutoff frequency (Hz) of DC-removal high-pass filter", 0.0, 1e6, True),
    Parameter("pp_bPreEmphasis", "boolean", False, "Flag to activate pre-emphasis"),
    Parameter(
        "pp_coefPreEmphasis",
        "double",
        0.97,
        "Coefficient for pre-emphasis compensation (usually between 0.9 and 1)",
        -1.0,
        1.0,
    ),
    Parameter("pp_bNormalizeRMS", "boolean", False, "Flag to activate binaural RMS normalization"),
    Parameter("pp_intTimeSecRMS", "double", 0.5, "Time constant (s) for automatic gain control", 0.0, 3600.0, True),
    Parameter("pp_bLevelScaling", "boolean", False, "Flag to activate the level scaling"),
    Parameter(
        "pp_refSPLdB",
        "double",
        100.0,
        "Reference dB SPL value to correspond to input signal RMS value of 1",
        -200.0,
        400.0,
        aliases=("pp_refSPLdBS",),
    ),
    Parameter("pp_bMiddleEarFiltering", "boolean", False, "Flag to activate middle ear filtering"),
    Parameter(
        "pp_middleEarModel",
        "string",
        "jepsen",
        "Middle ear filter model (jepsen or lopezpoveda)",
        choices=("jepsen", "lopezpoveda"),
        fallback="jepsen",
    ),
    Parameter("pp_bUnityComp", "boolean", False, "Compensation to have maximum of unity gain for middle ear filter"),
)
GAMMATONE_PARAMETERS = (
    Parameter(
        "fb_type",
        "string",
        "gammatone",
        "Filterbank type (gammatone or drnl)",
        choices=("gammatone", "drnl"),
        fallback="gammatone",
    ),
    Parameter("fb_lowFreqHz", "double", 80.0, "Lowest center frequency (Hz)", 0.0, 1e6, True),
    Parameter("fb_highFreqHz", "double", 8000.0, "Highest center frequency (Hz)", 0.0, 1e6, True),
    Parameter("fb_nERBs", "double", 1.0, "Distance between neighboring filters in ERBs", 0.0, 100.0, True),
    Parameter("fb_nChannels", "unsigned long", 0, "Number of channels; 0: as many as fb_nERBs gives", 0, MAX_SEQUENCE),
    Parameter(
        "fb_cfHz",
        "sequence<double>",
        (),
        "Channels center frequencies (Hz); empty: chosen from the other parameters",
        0.0,
        1e6,
        True,
    ),
    Parameter("fb_nGamma", "unsigned long", 4, "Gammatone rising slope order", 1, 128),
    Parameter("fb_bwERBs", "double", 1.018, "Bandwidth of the filters in ERBs", 0.0, 10_000.0, True),
)
IHC_PARAMETERS = (
    Parameter(
        "ihc_method",
        "string",
        "dau",
        "The IHC method name",
        choices=("none", "halfwave", "fullwave", "square", "hilbert", "joergensen", "dau", "breebart", "bernstein"),
        fallback="dau",
    ),
)
ILD_PARAMETERS = (_window("ild"), _window_size("ild"), _hop_size("ild"))
RATEMAP_PARAMETERS = (
    _window("rm"),
    _window_size("rm"),
    _hop_size("rm"),
    Parameter(
        "rm_scaling",
        "string",
        "power",
        "Scaling type (power or magnitude)",
        choices=("power", "magnitude"),
        fallback="power",
    ),
    Parameter(
        "rm_decaySec",
        "double",
        0.008,
        "Signal-smoothing leaky integrator time constant (s)",
        0.0,
        3600.0,
        open_minimum=True,
    ),
)
_CC_MAX_DELAY = Parameter(
    "cc_maxDelaySec", "double", 0.0011, "Maximum delay in cross-correlation computation (s)", 0.0, 10.0, True
)
CROSSCORRELATION_PARAMETERS = (
    _window("cc"),
    _window_size("cc"),
    _hop_size("cc"),
    _CC_MAX_DELAY,
)

KINDS: dict[str, ProcessorKind] = {
    k.kind: k
    for k in (
        ProcessorKind("input", "InputProc", "", "inputProcPort", INPUT_PARAMETERS, "input"),
        ProcessorKind("preProc", "PreProc", "input", "preProcPort", PREPROC_PARAMETERS, "time"),
        ProcessorKind("gammatone", "GammatoneProc", "preProc", "gammatonePort", GAMMATONE_PARAMETERS, "filterbank"),
        ProcessorKind("ihc", "IhcProc", "gammatone", "ihcPort", IHC_PARAMETERS, "innerhaircell"),
        ProcessorKind("ild", "IldProc", "ihc", "ildPort", ILD_PARAMETERS, "ild"),
        ProcessorKind(
            "ratemap",
            "RatemapProc",
            "ihc",
            "ratemapPort",
            RATEMAP_PARAMETERS,
            "ratemap",
            {"set_rm_scailing": "rm_scaling"},
        ),
        ProcessorKind(
            "crossCorrelation",
            "CrossCorrelationProc",
            "ihc",
            "crossCorrelationPort",
            CROSSCORRELATION_PARAMETERS,
            "crosscorrelation",
        ),
    )
}

# --- rosAFE: types ----------------------------------------------------------------------------------------------

_TIME_DOMAIN = "::rosAFE::TimeDomainSignalPortStruct"
_TIME_FREQUENCY = "::rosAFE::TimeFrequencySignalPortStruct"
_CROSS_CORRELATION = "::rosAFE::CrossCorrelationSignalPortStruct"
_PORT_HEAD = (
    ("sampleRate", "unsigned long"),
    ("lastFrameIndex", "unsigned long long"),
    ("framesOnPort", "unsigned long long"),
)


def _parameter_struct(parameters: tuple[Parameter, ...]) -> tuple[tuple[str, str], ...]:
    return (("name", "string"), *((p.name, p.idl) for p in parameters))


_ROSAFE_STRUCTS: dict[str, tuple[tuple[str, str], ...]] = {
    "::rosAFE::signalOneD": (("data", "sequence<double>"),),
    "::rosAFE::signalND": (("dataN", "sequence<::rosAFE::signalOneD>"),),
    "::rosAFE::signalNxND": (("dataNxN", "sequence<::rosAFE::signalND>"),),
    _TIME_DOMAIN: (*_PORT_HEAD, ("left", "::rosAFE::signalOneD"), ("right", "::rosAFE::signalOneD")),
    _TIME_FREQUENCY: (
        *_PORT_HEAD,
        ("numberOfChannels", "unsigned long"),
        ("left", "::rosAFE::signalND"),
        ("right", "::rosAFE::signalND"),
    ),
    _CROSS_CORRELATION: (
        *_PORT_HEAD,
        ("numberOfLags", "unsigned long long"),
        ("numberOfChannels", "unsigned long"),
        ("left", "::rosAFE::signalNxND"),
    ),
    "::rosAFE::inputProcsParametres": _parameter_struct(INPUT_PARAMETERS),
    "::rosAFE::preProcsParametres": _parameter_struct(PREPROC_PARAMETERS),
    "::rosAFE::gammatoneProcsParametres": _parameter_struct(GAMMATONE_PARAMETERS),
    "::rosAFE::ihcProcsParametres": _parameter_struct(IHC_PARAMETERS),
    "::rosAFE::ildProcsParametres": _parameter_struct(ILD_PARAMETERS),
    "::rosAFE::ratemapProcsParametres": _parameter_struct(RATEMAP_PARAMETERS),
    "::rosAFE::crossCorrelationParametres": (
        *_parameter_struct(CROSSCORRELATION_PARAMETERS),
        ("cc_lags", "sequence<double>"),
    ),
    "::rosAFE::parameters": (
        ("input", "sequence<::rosAFE::inputProcsParametres>"),
        ("preProc", "sequence<::rosAFE::preProcsParametres>"),
        ("gammatone", "sequence<::rosAFE::gammatoneProcsParametres>"),
        ("ihc", "sequence<::rosAFE::ihcProcsParametres>"),
        ("ild", "sequence<::rosAFE::ildProcsParametres>"),
        ("ratemap", "sequence<::rosAFE::ratemapProcsParametres>"),
        ("crossCorrelation", "sequence<::rosAFE::crossCorrelationParametres>"),
    ),
    "::rosAFE::dataObjSt": (
        ("input", f"sequence<{_TIME_DOMAIN}>"),
        ("preProc", f"sequence<{_TIME_DOMAIN}>"),
        ("gammatone", f"sequence<{_TIME_FREQUENCY}>"),
        ("ihc", f"sequence<{_TIME_FREQUENCY}>"),
        ("ild", f"sequence<{_TIME_FREQUENCY}>"),
        ("ratemap", f"sequence<{_TIME_FREQUENCY}>"),
        ("crossCorrelation", f"sequence<{_CROSS_CORRELATION}>"),
    ),
}

# --- rosAFE: requests and ports ---------------------------------------------------------------------------------

_PROCESSOR_THROWS = (
    "::rosAFE::e_noUpperDependencie",
    "::rosAFE::e_existsAlready",
    "::rosAFE::e_noSuchProcessor",
    "::rosAFE::e_badNewValue",
)

_BLOCK_AND_BUFFERS = (
    Parameter("nFramesPerBlock", "unsigned long", 12000, "Frames in one block", 1, MAX_BLOCK),
    Parameter("bufferSize_s_port", "double", 1.0, "Seconds of signal on every output port", 0.0, MAX_SECONDS, True),
    Parameter(
        "bufferSize_s_getSignal",
        "double",
        1.0,
        "Seconds of signal that getSignals can return; raised to two blocks where it is less",
        0.0,
        MAX_SECONDS,
        True,
    ),
)
REQUEST = Service(
    "request",
    "Build what a representation needs, or find it in the tree of processors",
    (
        Parameter(
            "representation",
            "string",
            REQUIRED,
            "What is wanted, such as ild",
            choices=tuple(kind.representation for kind in KINDS.values()),
        ),
        Parameter("connect", "string", "bass/Audio", "Topic for the Audio port, where a new input needs one"),
        *_BLOCK_AND_BUFFERS,
        *(parameter for kind in KINDS.values() for parameter in kind.parameters),
    ),
    outputs=(
        ("name", "string"),
        ("dependencies", "sequence<string>"),
        ("created", "sequence<string>"),
        ("reused", "sequence<string>"),
        ("unused", "sequence<string>"),
        ("port", "string"),
        ("topic", "string"),
    ),
    throws=("::rosAFE::e_noData", "::rosAFE::e_noMemory", "::rosAFE::e_existsAlready", "::rosAFE::e_badNewValue"),
)

ROSAFE = Component(
    name="rosAFE",
    doc="The Two!Ears auditory front-end: a tree of processors that compute auditory representations",
    services=(
        Service(
            "InputProc",
            "Read the audio that comes in on the Audio port, block by block",
            (_name("input", "Name of the activity"), *_BLOCK_AND_BUFFERS),
            throws=(
                "::rosAFE::e_noData",
                "::rosAFE::e_noMemory",
                "::rosAFE::e_existsAlready",
                "::rosAFE::e_badNewValue",
            ),
            activity=True,
            task="input",
            interrupts=("InputProc",),
        ),
        Service(
            "PreProc",
            "Condition the input: DC removal, pre-emphasis, gain control, level scaling, middle ear",
            (_name("preProc", "The name of this activity"), _upper("input"), *PREPROC_PARAMETERS),
            throws=_PROCESSOR_THROWS,
            activity=True,
            task="preProc",
        ),
        Service(
            "GammatoneProc",
            "Split the signal into frequency channels",
            (_name("gammatone", "The name of this activity"), _upper("preProc"), *GAMMATONE_PARAMETERS),
            throws=_PROCESSOR_THROWS,
            activity=True,
            task="gammatoneProc",
            aliases=("Gammatone",),
        ),
        Service(
            "IhcProc",
            "Inner hair cell representation",
            (_name("ihc", "The name of this activity"), _upper("gammatone"), *IHC_PARAMETERS),
            throws=_PROCESSOR_THROWS,
            activity=True,
            task="ihcProc",
        ),
        Service(
            "IldProc",
            "Interaural level difference",
            (_name("ild", "The name of this ild processor"), _upper("ihc"), *ILD_PARAMETERS),
            throws=_PROCESSOR_THROWS,
            activity=True,
            task="ildProc",
        ),
        Service(
            "RatemapProc",
            "Ratemap (cochleagram)",
            (_name("ratemap", "The name of this ratemap processor"), _upper("ihc"), *RATEMAP_PARAMETERS),
            throws=_PROCESSOR_THROWS,
            activity=True,
            task="ratemapProc",
            aliases=("Ratemap",),
        ),
        Service(
            "CrossCorrelationProc",
            "Interaural cross-correlation",
            (
                _name("crosscorrelation", "The name of this cross-correlation processor"),
                _upper("ihc"),
                _window_size("cc"),
                _hop_size("cc"),
                _CC_MAX_DELAY,
                _window("cc"),
            ),
            throws=_PROCESSOR_THROWS,
            activity=True,
            task="crossCorrelationProc",
            aliases=("CrossCorrelation",),
        ),
        Service(
            "getSignals",
            "The data that all processors computed since the last call",
            outputs=(("signals", "::rosAFE::dataObjSt"),),
            throws=("::rosAFE::e_noMemory", "::rosAFE::e_badIndexParam"),
            aliases=("getSignal",),
        ),
        Service(
            "getDependencies",
            "The names of the processors from the input down to the named one",
            (Parameter("nameProc", "string", "nameProc", "The name of the processor"),),
            outputs=(("dependencies", "sequence<string>"),),
            throws=("::rosAFE::e_noMemory", "::rosAFE::e_noSuchProcessor"),
        ),
        Service(
            "getParameters",
            "The parameters of all processors",
            outputs=(("parameters", "::rosAFE::parameters"),),
            throws=("::rosAFE::e_noMemory",),
        ),
        Service(
            "modifyParameter",
            "Change one parameter of a processor from its next block on",
            (
                Parameter("nameProc", "string", "nameProc", "The name of the processor to change the parameter"),
                Parameter("nameParam", "string", "nameParam", "The name of the parameter to be changed"),
                Parameter("newValue", "string", "newValue", "The new value of the parameter to be changed"),
            ),
            throws=(
                "::rosAFE::e_noMemory",
                "::rosAFE::e_noSuchProcessor",
                "::rosAFE::e_noSuchParameter",
                "::rosAFE::e_badNewValue",
            ),
        ),
        Service(
            "removeProcessor",
            "Remove a processor and all that depend on it; the input cannot be removed",
            (Parameter("name", "string", "name", "The name of the processor to delete", aliases=("nameProc",)),),
            throws=("::rosAFE::e_noSuchProcessor",),
        ),
        Service(
            "Stop",
            "Stop and remove all processors; port connections stay",
            interrupts=(
                "InputProc",
                "PreProc",
                "GammatoneProc",
                "IhcProc",
                "IldProc",
                "RatemapProc",
                "CrossCorrelationProc",
            ),
        ),
        *COMMON_SERVICES,
    ),
    ports=(
        Port("Audio", "::binaudio::portStruct", "Binaural audio to work on", output=False),
        Port("inputProcPort", _TIME_DOMAIN, "What the input processor put out"),
        Port("preProcPort", _TIME_DOMAIN, "What each pre-processor put out", multiple=True),
        Port("gammatonePort", _TIME_FREQUENCY, "What each filterbank put out", multiple=True),
        Port("ihcPort", _TIME_FREQUENCY, "What each inner hair cell processor put out", multiple=True),
        Port("ildPort", _TIME_FREQUENCY, "Interaural level differences (dB), in `left`", multiple=True),
        Port("ratemapPort", _TIME_FREQUENCY, "Ratemaps", multiple=True, aliases=("ratemapProcPort",)),
        Port("crossCorrelationPort", _CROSS_CORRELATION, "Cross-correlations, [lag][channel][frame]", multiple=True),
        Port("dataObj", "::rosAFE::dataObjSt", "Advertised as in the original and, as there, never written"),
        GENOM_STATE_PORT,
    ),
    tasks=(
        "init",
        "input",
        "preProc",
        "gammatoneProc",
        "ihcProc",
        "ildProc",
        "ratemapProc",
        "crossCorrelationProc",
    ),
    exceptions={
        "e_noData": "no audio on the Audio port",
        "e_noMemory": "out of memory",
        "e_existsAlready": "a processor of this name exists already",
        "e_noSuchProcessor": "no processor of this name",
        "e_noSuchParameter": "the processor has no such parameter",
        "e_noUpperDependencie": "no processor of the right type has the name given as upper dependency",
        "e_badIndexParam": "bad index",
        "e_badNewValue": "a value of the wrong type or out of its range",
    },
    structs={**_ROSAFE_STRUCTS, **_BINAUDIO, **_GENOM_STATE},
    composites=(REQUEST,),
)

# --- bass -------------------------------------------------------------------------------------------------------

BASS = Component(
    name="bass",
    doc="Binaural audio streaming server: captures sound and publishes a sliding window of it",
    services=(
        Service(
            "Acquire",
            "Capture from a device and publish on Audio until stopped",
            (
                Parameter("device", "string", "hw:1,0", "ALSA name of the sound device, file:PATH, bag:PATH or scene:"),
                Parameter(
                    "sampleRate",
                    "unsigned long",
                    44100,
                    "Sample rate (Hz); 0: the source's own with file: and bag:, else 44100",
                    0,
                    768000,
                    zero_is_default=False,
                ),
                Parameter("nFramesPerChunk", "unsigned long", 2205, "Frames in one chunk", 1, 1_000_000),
                Parameter("nChunksOnPort", "unsigned long", 20, "Chunks in the window on the port", 1, 100_000),
            ),
            throws=("::bass::e_nomem", "::bass::e_device", "::bass::e_hwparams", "::bass::e_swparams"),
            activity=True,
            task="capture",
            interrupts=("Acquire",),
        ),
        Service(
            "ListDevices",
            "Print the capture devices on the component's standard output",
            throws=("::bass::e_nodevice",),
        ),
        Service("Stop", "Stop the acquisition", interrupts=("Acquire",)),
        Service(
            "DedicatedSocket",
            "Serve the Audio port's content on TCP port 8081 until closed",
            activity=True,
            task="socket",
            interrupts=("DedicatedSocket",),
        ),
        Service(
            "CloseSocket",
            "Close the dedicated socket and all its connections",
            activity=True,
            task="socket",
            interrupts=("DedicatedSocket",),
        ),
        *COMMON_SERVICES,
    ),
    ports=(
        Port("Audio", "::binaudio::portStruct", "The newest audio: a window that slides by one chunk"),
        GENOM_STATE_PORT,
    ),
    tasks=("capture", "socket"),
    exceptions={
        "e_nomem": "out of memory",
        "e_nodevice": "no sound card",
        "e_device": "the device does not exist, is busy or is gone",
        "e_hwparams": "the device does not offer what was asked for",
        "e_swparams": "the device's software parameters cannot be set",
    },
    structs={**_BINAUDIO, **_GENOM_STATE},
)

COMPONENTS = {c.name: c for c in (ROSAFE, BASS)}


def all_services() -> Iterator[tuple[Component, Service]]:
    """Every (component, service) pair."""
    for component in COMPONENTS.values():
        for service in component.services:
            yield component, service
