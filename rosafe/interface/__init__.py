"""The interface table: requests, parameters, types, exceptions and ports of the components `rosAFE` and `bass`.

The nodes, the HTTP server, the Tcl help, the documentation and the files in msg/, srv/ and action/ are derived from
this table. It is derived from the declarations of the representations (rosafe/representations), the only place that
defines the name, type, default, range and order of a parameter. Structures that do not depend on representations are in
the IDL files of this folder.
"""

from __future__ import annotations

from rosafe.declarations.errors import ComponentError
from rosafe.declarations.idl import ros_type
from rosafe.declarations.parameter import MAX_SEQUENCE, MAX_STRING, REQUIRED, Parameter, format_value
from rosafe.declarations.representation import Representation
from rosafe.representations import KINDS, PLUGINS, PROBLEMS

from .bass import BASS
from .genom import COMMON_SERVICES, GENOM_EXCEPTIONS, GENOM_STATE_PORT, MAX_ACTIVITIES
from .rosafe import (
    BLOCK_AND_BUFFERS,
    CORE_REPRESENTATIONS,
    FIND,
    LAYOUTS,
    LOAD_SETUP,
    MAX_SECONDS,
    MAX_SETUP,
    REQUEST,
    RESTORED_PARAM,
    ROSAFE,
    SAVE_SETUP,
)
from .service import ComponentSpec, PortSpec, Service

COMPONENTS = {c.name: c for c in (ROSAFE, BASS)}
