"""The component `rosAFE`, derived from the representations that there are: requests, ports, structs, tasks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rosafe.declarations.idl import TIME
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.representation import Representation
from rosafe.declarations.signals import SIGNALS, layout
from rosafe.representations import KINDS
from rosafe.representations.registry import CORE_KINDS

from .bass import BINAUDIO
from .genom import COMMON_SERVICES, GENOM_STATE, GENOM_STATE_PORT
from .service import ComponentSpec, PortSpec, Service, Struct

MAX_SECONDS = 600.0  # longest port or history
MAX_BLOCK = 10_000_000  # frames
MAX_SETUP = 4 * 2**20  # characters of a setup; over HTTP, the length of a URL is what bounds it
MAX_PARAMETERS = 2**18  # characters of the parameters of a request for a whole tree, by a service of ROS

Kinds = Mapping[str, Representation]  # parents first

LAYOUTS = {kind: layout(representation) for kind, representation in KINDS.items()}
CORE_REPRESENTATIONS = {
    kind: KINDS[kind] for kind in CORE_KINDS if kind in KINDS
}  # what getParameters and getSignals report

# --- types ------------------------------------------------------------------------------------------------------


def parameter_struct(kind: str) -> str:
    """The struct of getParameters for one of the original's kinds."""
    if kind == "crossCorrelation":
        return "::rosAFE::crossCorrelationParametres"
    return f"::rosAFE::{kind.removesuffix('Proc')}ProcsParametres"


def _structs(kinds: Kinds) -> dict[str, Struct]:
    structs = dict(SIGNALS)
    for kind in kinds:
        structs[LAYOUTS[kind].idl] = LAYOUTS[kind].members
    for kind, representation in CORE_REPRESENTATIONS.items():
        structs[parameter_struct(kind)] = (
            ("name", "string"),
            *((p.name, p.idl) for p in representation.parameters),
            *((d.name, d.idl) for d in representation.derived),
        )
    structs["::rosAFE::parameters"] = tuple(
        (kind, f"sequence<{parameter_struct(kind)}>") for kind in CORE_REPRESENTATIONS
    )
    structs["::rosAFE::dataObjSt"] = tuple((kind, f"sequence<{LAYOUTS[kind].idl}>") for kind in CORE_REPRESENTATIONS)
    structs["::rosAFE::frameTime"] = (("stamp", TIME), ("frameIndex", "unsigned long long"), ("sampleRate", "double"))
    structs["::rosAFE::parameterValue"] = (("name", "string"), ("value", "string"))
    structs["::rosAFE::processor"] = (
        *((name, "string") for name in ("name", "kind", "request", "upperDepName", "port", "topic")),
        ("rate", "double"),
        ("shape", "sequence<unsigned long>"),
        ("axes", "sequence<string>"),
        ("parameters", "sequence<::rosAFE::parameterValue>"),
    )
    structs["::rosAFE::representation"] = (
        ("name", "string"),
        ("rate", "double"),
        ("lastFrameIndex", "unsigned long long"),
        ("axes", "sequence<string>"),
        ("shape", "sequence<unsigned long>"),
        ("data", "sequence<double>"),
    )
    return structs


# --- requests ---------------------------------------------------------------------------------------------------

BLOCK_AND_BUFFERS = (
    Parameter("nFramesPerBlock", "unsigned long", 12000, "Frames in one block", 1, MAX_BLOCK),
    Parameter(
        "bufferSize_s_port",
        "double",
        1.0,
        "Seconds of signal on every output port",
        0.0,
        MAX_SECONDS,
        open_minimum=True,
        unit="s",
    ),
    Parameter(
        "bufferSize_s_getSignal",
        "double",
        1.0,
        "Seconds of signal that getSignals can return; raised to two blocks where it is less",
        0.0,
        MAX_SECONDS,
        open_minimum=True,
        unit="s",
    ),
)
_INPUT_THROWS = ("::rosAFE::e_noData", "::rosAFE::e_noMemory", "::rosAFE::e_existsAlready", "::rosAFE::e_badNewValue")
_PROCESSOR_THROWS = (
    "::rosAFE::e_noUpperDependencie",
    "::rosAFE::e_existsAlready",
    "::rosAFE::e_noSuchProcessor",
    "::rosAFE::e_badNewValue",
)


def _creation_service(representation: Representation, kinds: Kinds) -> Service:
    """The request that adds a processor."""
    name = Parameter("name", "string", representation.name, representation.name_doc)
    parent = representation.parent
    if not parent:
        return Service(
            representation.request,
            representation.doc,
            (name, *BLOCK_AND_BUFFERS),
            throws=_INPUT_THROWS,
            activity=True,
            task=representation.kind,
            interrupts=(representation.request,),
        )
    upper = Parameter("upperDepName", "string", kinds[parent].name, "The name of the upper dependency")
    return Service(
        representation.request,
        representation.doc,
        (name, upper, *representation.request_parameters),
        throws=_PROCESSOR_THROWS,
        activity=True,
        task=representation.task,
        aliases=representation.request_aliases,
    )


def _whole_trees(kinds: Kinds) -> tuple[Service, ...]:
    """The requests for a representation and all that it needs: to build it, and to find what is there of it."""
    build = Service(
        "request",
        "Build what a representation needs, or find it in the tree of processors",
        (
            Parameter(
                "representation",
                "string",
                REQUIRED,
                "What is wanted, such as ild",
                choices=tuple(kind.word for kind in kinds.values()),
            ),
            Parameter("connect", "string", "bass/Audio", "Topic for the Audio port, where a new input needs one"),
            *BLOCK_AND_BUFFERS,
            *{p.name: p for kind in kinds.values() for p in kind.parameters}.values(),  # some are of two kinds
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
        throws=_INPUT_THROWS,
    )
    find = replace(
        build,
        name="find",
        doc="What the request would use for a representation if all of it is there; nothing is made",
        throws=("::rosAFE::e_noSuchProcessor", "::rosAFE::e_existsAlready", "::rosAFE::e_badNewValue"),
    )
    save = Service(
        "saveSetup",
        "The tree of processors with its sound, as the text of a file that loadSetup takes",
        (Parameter("full", "boolean", False, "Flag to write what has its default value, too"),),
        outputs=(("setup", "string"),),
    )
    load = Service(
        "loadSetup",
        "Build all that a setup describes, beside what is there: wholly, or nothing is changed",
        (Parameter("setup", "string", REQUIRED, "The text of a setup (YAML)", longest=MAX_SETUP),),
        outputs=(("created", "sequence<string>"), ("reused", "sequence<string>"), ("sound", "string")),
        throws=_INPUT_THROWS,
    )
    return build, find, save, load


def _ros_service(composites: tuple[Service, ...]) -> tuple[Service, ...]:
    """The request for a whole tree, as a service of ROS."""
    build = composites[0]
    parameters = (
        Parameter("representation", "string", REQUIRED, "What is wanted, such as ild: see request.md"),
        Parameter(
            "parameters",
            "string",
            "",
            "Parameters of it and of all above it, as YAML: 'fb_nChannels: 16, pi_rangeHz: [80, 300]'",
            longest=MAX_PARAMETERS,
        ),
        Parameter(
            "connect",
            "string",
            "",
            "Topic for the Audio port, where a new input needs one; empty: bass/Audio, unless it is connected",
        ),
    )
    return (replace(build, parameters=parameters),)


_FUNCTIONS = (
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
        "getProcessors",
        "All processors of every kind: what they are, hang on and put out, and their parameters",
        outputs=(("processors", "sequence<::rosAFE::processor>"),),
        throws=("::rosAFE::e_noMemory",),
    ),
    Service(
        "getRepresentation",
        "What one processor, of whatever kind, put out since this was last asked for it",
        (Parameter("name", "string", "name", "The name of the processor"),),
        outputs=(("parts", "sequence<::rosAFE::representation>"),),
        throws=("::rosAFE::e_noMemory", "::rosAFE::e_noSuchProcessor"),
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
)

# --- the component ----------------------------------------------------------------------------------------------


def derive(kinds: Kinds) -> ComponentSpec:
    """The component whose processors are of these kinds."""
    adding = tuple(_creation_service(kind, kinds) for kind in kinds.values())
    composites = _whole_trees(kinds)
    stop = Service(
        "Stop",
        "Stop and remove all processors; port connections stay",
        interrupts=tuple(service.name for service in adding),
    )
    ports = (
        PortSpec(
            kind.port, LAYOUTS[kind.kind].idl, kind.port_doc, multiple=bool(kind.parent), aliases=kind.port_aliases
        )
        for kind in kinds.values()
    )
    return ComponentSpec(
        name="rosAFE",
        doc="The Two!Ears auditory front-end: a tree of processors that compute auditory representations",
        services=(*adding, *_FUNCTIONS, stop, *COMMON_SERVICES),
        ports=(
            PortSpec("Audio", "::binaudio::portStruct", "Binaural audio to work on", output=False),
            *ports,
            PortSpec(
                "frameTime",
                "::rosAFE::frameTime",
                "With each block, when its newest audio frame was captured, and how many frames a second come",
            ),
            PortSpec("dataObj", "::rosAFE::dataObjSt", "Advertised as in the original and, as there, never written"),
            GENOM_STATE_PORT,
        ),
        tasks=("init", *(service.task for service in adding)),
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
        structs={**_structs(kinds), **BINAUDIO, **GENOM_STATE},
        client_side_services=composites,
        ros_services=_ros_service(composites),
    )


ROSAFE = derive(KINDS)
REQUEST, FIND, SAVE_SETUP, LOAD_SETUP = ROSAFE.client_side_services
