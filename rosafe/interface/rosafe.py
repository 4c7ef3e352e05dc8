"""The component `rosAFE`, derived from the available representations: requests, ports, structs, tasks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rosafe.declarations.block_length import DEFAULT_FRAMES_PER_BLOCK, MAX_FRAMES_PER_BLOCK
from rosafe.declarations.parameter import REQUIRED, Parameter
from rosafe.declarations.representation import Representation
from rosafe.declarations.signals import SIGNALS, layout
from rosafe.representations import KINDS
from rosafe.representations.registry import CORE_KINDS

from .bass import BINAUDIO
from .genom import COMMON_SERVICES, GENOM_STATE, GENOM_STATE_PORT
from .service import ComponentSpec, PortSpec, Service, Struct, read_idl

MAX_SECONDS = 600.0  # of a port or history
MAX_SETUP = 4 * 2**20  # characters of a setup; over HTTP, the URL length is the lower limit
RESTORED_PARAM = "restored"  # private ROS parameter: address of the node and the processors that it restores (`--keep`)
MAX_PARAMETERS = 2**18  # characters of the parameters of a request for a whole tree, as a ROS service

_IDL = read_idl(__file__)
Kinds = Mapping[str, Representation]  # parents first

LAYOUTS = {kind: layout(representation) for kind, representation in KINDS.items()}
# Representations that getParameters and getSignals return.
CORE_REPRESENTATIONS = {kind: KINDS[kind] for kind in CORE_KINDS if kind in KINDS}

# --- types ------------------------------------------------------------------------------------------------------


def parameter_struct(kind: str) -> str:
    """Return the struct of getParameters for one of the original's kinds."""
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
    return {**structs, **_IDL["struct"]}


# --- requests ---------------------------------------------------------------------------------------------------

BLOCK_AND_BUFFERS = (
    Parameter.count("nFramesPerBlock", DEFAULT_FRAMES_PER_BLOCK, "Frames in one block", 1, MAX_FRAMES_PER_BLOCK),
    Parameter.positive("bufferSize_s_port", 1.0, "Seconds of signal on every output port", MAX_SECONDS, unit="s"),
    Parameter.positive(
        "bufferSize_s_getSignal",
        1.0,
        "Seconds of signal that getSignals can return; at least two blocks",
        MAX_SECONDS,
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
    """Return the request that adds a processor."""
    name = Parameter.text("name", representation.name, representation.name_doc)
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
    upper = Parameter.text("upperDepName", kinds[parent].name, "The name of the upper dependency")
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
    """Return the requests for whole trees: build or find a representation with its ancestors, save or load a setup."""
    build = Service(
        "request",
        "Build a representation with all processors that it needs; existing processors are used",
        (
            Parameter.text(
                "representation",
                REQUIRED,
                "The representation, such as ild",
                tuple(kind.word for kind in kinds.values()),
            ),
            Parameter.text("connect", "bass/Audio", "Topic for the Audio port, if a new input needs one"),
            *BLOCK_AND_BUFFERS,
            *{p.name: p for kind in kinds.values() for p in kind.parameters}.values(),  # two kinds share some
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
        doc="Find the processors that `request` would use, if all of them exist; none is created",
        throws=("::rosAFE::e_noSuchProcessor", "::rosAFE::e_existsAlready", "::rosAFE::e_badNewValue"),
    )
    save = Service(
        "saveSetup",
        "The tree of processors and its sound, as the text of a setup file for loadSetup; without the localizer",
        (Parameter.flag("full", False, "Flag to include parameters that have their default values"),),
        outputs=(("setup", "string"),),
    )
    load = Service(
        "loadSetup",
        "Build the tree that a setup describes, in addition to existing processors: completely, or without any change. "
        "The section localizer is for `rosafe up` and `rosafe setup load`",
        (Parameter.text("setup", REQUIRED, "The text of a setup (YAML)", longest=MAX_SETUP),),
        outputs=(("created", "sequence<string>"), ("reused", "sequence<string>"), ("sound", "string")),
        throws=_INPUT_THROWS,
    )
    return build, find, save, load


def _ros_services(composites: tuple[Service, ...]) -> tuple[Service, ...]:
    """Return the requests for whole trees as ROS services."""
    build, find, save, load = composites
    parameters = (
        Parameter.text("representation", REQUIRED, "The representation, such as ild: see request.md"),
        Parameter.text(
            "parameters",
            "",
            "Parameters of it and of its ancestors, as YAML: 'fb_nChannels: 16, pi_rangeHz: [80, 300]'",
            longest=MAX_PARAMETERS,
        ),
        Parameter.text(
            "connect",
            "",
            "Topic for the Audio port, if a new input needs one; empty: bass/Audio, unless the port is connected",
        ),
    )
    return (
        replace(build, parameters=parameters),
        replace(find, parameters=parameters),
        replace(save, doc="The tree of processors and its connection, as the text of a setup, without sound"),
        replace(
            load,
            doc="Connect the Audio port and build the tree that a setup describes: completely, or without any change. "
            "The section sound is for clients, which call bass",
            parameters=(
                *load.parameters,
                Parameter.flag(
                    "check",
                    False,
                    "Flag to change nothing, and to return the names of the processors that it would create",
                ),
            ),
            outputs=load.outputs[:2],
        ),
        Service(
            "removeUnused",
            "Remove processors, except those that others depend on",
            (Parameter("names", "sequence<string>", (), "The names, in the order of their creation"),),
            outputs=(("removed", "sequence<string>"),),
        ),
    )


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
        (Parameter.text("nameProc", "nameProc", "The name of the processor"),),
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
        "All processors of every kind: their kinds, parents, outputs and parameters",
        outputs=(("processors", "sequence<::rosAFE::processor>"),),
        throws=("::rosAFE::e_noMemory",),
    ),
    Service(
        "getRepresentation",
        "The output of one processor of any kind since the last call for this processor",
        (Parameter.text("name", "name", "The name of the processor"),),
        outputs=(("parts", "sequence<::rosAFE::representation>"),),
        throws=("::rosAFE::e_noMemory", "::rosAFE::e_noSuchProcessor"),
    ),
    Service(
        "modifyParameter",
        "Change one parameter of a processor from its next block on",
        (
            Parameter.text("nameProc", "nameProc", "The name of the processor to change the parameter"),
            Parameter.text("nameParam", "nameParam", "The name of the parameter to be changed"),
            Parameter.text("newValue", "newValue", "The new value of the parameter to be changed"),
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
        (Parameter.text("name", "name", "The name of the processor to delete", aliases=("nameProc",)),),
        throws=("::rosAFE::e_noSuchProcessor",),
    ),
)

# --- the component ----------------------------------------------------------------------------------------------


def derive(kinds: Kinds) -> ComponentSpec:
    """Return the component whose processors are of these kinds."""
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
            PortSpec("Audio", "::binaudio::portStruct", "Binaural audio to process", output=False),
            *ports,
            PortSpec(
                "frameTime",
                "::rosAFE::frameTime",
                "For each block, the capture time of its newest audio frame and the measured sample rate",
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
        messages=_IDL["message"],
        client_side_services=composites,
        ros_services=_ros_services(composites),
    )


ROSAFE = derive(KINDS)
REQUEST, FIND, SAVE_SETUP, LOAD_SETUP = ROSAFE.client_side_services
WHOLE_TREES = (REQUEST, FIND)  # requests with parameters of all kinds, in which defaults are not filled in
