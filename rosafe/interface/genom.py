"""The parts common to all GenoM components: exceptions, requests, and the published state."""

from __future__ import annotations

from rosafe.declarations.parameter import REQUIRED, Parameter

from .service import PortSpec, Service, read_idl

_IDL = read_idl(__file__)
GENOM_EXCEPTIONS, GENOM_STATE = _IDL["exception"], _IDL["struct"]

MAX_ACTIVITIES = 256  # per task, including its permanent one; deviation: the original has at most 32
REJECTED_GOAL = "rejected"  # text of an accepted goal whose result, with the error, follows at once

_PORT_NAMES = (
    Parameter.text("local", REQUIRED, "Name of this component's input port"),
    Parameter.text("remote", REQUIRED, "Name of the topic to read, such as bass/Audio"),
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
            Parameter.text("local", REQUIRED, "Name of this component's remote"),
            Parameter.text("remote", REQUIRED, "Name of the service to use"),
        ),
        throws=("::genom::no_such_remote", "::genom::no_such_service", "::genom::remote_io"),
    ),
    Service(
        "abort_activity",
        "End one activity",
        (Parameter.count("activity", REQUIRED, "Number of the activity, as genom_state shows it"),),
        throws=("::genom::no_such_activity",),
    ),
    Service("kill", "End all activities and the component"),
)

GENOM_STATE_PORT = PortSpec("genom_state", "::genom_state::component", "Tasks and live activities of the component")
