"""Python client of genomixd: services and ports of GenoM components without ROS.

::

    import genomix
    g = genomix.connect()                # or "host", "host:port"
    rosAFE = g.load("rosAFE")
    rosAFE.connect_port({"local": "Audio", "remote": "bass/Audio"})
    rosAFE.InputProc(ack=True)           # returns when the activity runs
    rosAFE.getParameters()               # returns the outputs as a dictionary
    help(rosAFE.GammatoneProc)           # parameters with types, defaults and ranges

docs/genomix-python.md describes the package.
"""

from __future__ import annotations

import time

from genomix import event
from genomix.client import Client
from genomix.component import Component
from genomix.event import GenoMError
from genomix.request import Request, Status

__all__ = ["Client", "Component", "GenoMError", "Request", "Status", "connect", "event", "update"]


def connect(address: str = "") -> Client:
    """Connect to genomixd.

    Parameters
    ----------
    address : str
        ``"host"`` or ``"host:port"``; by default the environment variable GENOMIXD, or port 8080 of this machine.

    Raises
    ------
    GenoMError
        ``::genom::mwerr`` if no genomixd answers at the address.
    """
    return Client(address)


def update() -> None:
    """Pause for 10 ms. Loops of public scripts call it between two looks at the status of a request.

    The status is always current, also without this call.
    """
    time.sleep(0.01)
