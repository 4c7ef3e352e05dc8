"""Node succession: of several nodes with the same name the newest continues, as ROS specifies.

The master stores one address per name. The node that registers last under a name owns it, and the master asks the
previous one to shut down. However, any registration counts: a late registration of an ending node takes the name back,
and the master then asks the new node to shut down. Therefore a node that was asked to shut down registers nothing more,
and a node ignores a request that the node it replaces has caused, or that is out of date: it owns the name again.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import rospy.core
from rospy.impl.masterslave import ROSHandler

from rosafe.ros1.transport import master

REASON = "new node registered with same name"  # in the master's request to shut down


class Succession:
    """Whether this node owns its name.

    Parameters
    ----------
    name : str
        Name of the node, with its namespace.
    uri : str
        Address of the master.

    Attributes
    ----------
    registration_lock : threading.Lock
        Held during each call that registers something.
    over : bool
        Another node has taken the name: nothing may be registered any more.
    up : bool
        This node has started. Until then it may be one of several that start at the same time.
    """

    def __init__(self, name: str, uri: str) -> None:
        self.registration_lock = threading.Lock()
        self.over = False
        self.up = False
        self.on_contest: Callable[[], None] = lambda: None  # this node keeps its name, but may have lost registrations
        self._name = name
        self._uri = uri
        self._predecessor = self._owner()

    def _owner(self) -> str | None:
        """Return the address that is registered for the name; None if there is none or the master does not answer."""
        with contextlib.suppress(*master.FAILURES):
            return master.node_address(self._uri, self._name)
        return None

    def ignores(self, address: str) -> bool:
        """Return whether the node at `address` ignores a request to shut down in favour of a newer one.

        It does if it is already ending, or if it continues. If nodes start at the same time, the one that registers
        last continues: each checks the owner only after its own last registration. A request may arrive after that.
        """
        with self.registration_lock:
            if self.over:
                return True
            owner = self._owner()
            replaced = owner is not None and owner == self._predecessor
            self.over = not (replaced or owner == address or (owner is None and not self.up))
        if not self.over:
            self.on_contest()
        return not self.over

    def is_lost(self, owner: str, address: str) -> bool:
        """Return whether `owner`, and not this node at `address`, keeps the name according to the master."""
        return owner not in (address, self._predecessor) and not self.ignores(address)


class MasterProxy(rospy.core._LockedServerProxy):
    """rospy's proxy of the master, for rospy's own registrations: none is sent once another node has the name.

    Attributes
    ----------
    succession : Succession or None
        None until the node has an address.
    """

    succession: Succession | None = None

    def _ServerProxy__request(self, method: str, arguments: tuple[Any, ...]) -> Any:  # the name in xmlrpc.client
        if self.succession is None or not method.startswith("register"):
            return super()._ServerProxy__request(method, arguments)
        with self.succession.registration_lock:
            if self.succession.over:
                return 1, "not sent: the node ends", []
            return super()._ServerProxy__request(method, arguments)


class NodeApiHandler(ROSHandler):
    """The XML-RPC methods of this node, with the succession rule of this module."""

    def __init__(self, name: str, master_uri: str) -> None:
        super().__init__(name, master_uri)
        self.succession = Succession(name, master_uri)

    def shutdown(self, *arguments: Any) -> Any:
        """End the node, unless the node that it replaces has caused the request."""
        if any(REASON in str(argument) for argument in arguments) and self.succession.ignores(self.uri):
            return 1, "ignored", 0
        return super().shutdown(*arguments)

    def give_way(self) -> None:
        """End the node, on a separate thread, in favour of a newer one if the master's request did not arrive."""
        arguments = (self, "/master", f"[{self.name}] Reason: {REASON}")
        threading.Thread(target=ROSHandler.shutdown, args=arguments, daemon=True).start()
