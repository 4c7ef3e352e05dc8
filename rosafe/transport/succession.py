"""Which of several nodes of one name goes on: the newest, as the rule of ROS has it.

The master remembers one address per name. Whichever node registers last under a name has it, and the master asks the
previous one to shut down. But any registration counts: one that an ending node still has on its way takes the name
back, and the master then asks the new node to shut down. Therefore a node that is asked registers nothing more, and a
node that starts does not end for the one that it replaces.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from rospy.impl.masterslave import ROSHandler

from rosafe.transport import master

REASON = "new node registered with same name"  # in the master's request to shut down


class Succession:
    """Whether this node is the one that has its name.

    Parameters
    ----------
    name : str
        Of the node, with its namespace.
    uri : str
        Of the master.

    Attributes
    ----------
    turn : threading.Lock
        To be held during each call that registers something.
    over : bool
        Another node has taken the name: nothing may be registered any more.
    up : bool
        This node has started. Until then it may be one of several that start at the same time.
    """

    def __init__(self, name: str, uri: str) -> None:
        self.turn = threading.Lock()
        self.over = False
        self.up = False
        self.on_contest: Callable[[], None] = lambda: None  # registrations may have been lost, but the name is ours
        self._name = name
        self._uri = uri
        self._predecessor = self._owner()

    def _owner(self) -> str | None:
        """The address that the master has for the name; None if it has none, or does not answer."""
        with contextlib.suppress(*master.FAILURES):
            return master.node_address(self._uri, self._name)
        return None

    def ignores(self, address: str) -> bool:
        """Return whether the node at `address` ignores that it was asked to shut down for a newer one.

        It does if it ends already, or goes on. Of two nodes that start at the same time, the one whose registration
        comes last goes on: each looks at the master only after its own last registration.
        """
        with self.turn:
            if self.over:
                return True
            owner = self._owner()
            replaced = owner is not None and owner == self._predecessor
            self.over = not (replaced or (not self.up and owner in (address, None)))
        if not self.over:
            self.on_contest()
        return not self.over

    def is_lost(self, owner: str, address: str) -> bool:
        """Return whether the master has told that another node than this one at `address` has the name for good."""
        return owner not in (address, self._predecessor) and not self.ignores(address)


class NodeApiHandler(ROSHandler):
    """The XML-RPC methods of this node, with the rule of this module."""

    def __init__(self, name: str, master_uri: str) -> None:
        super().__init__(name, master_uri)
        self.succession = Succession(name, master_uri)

    def shutdown(self, *arguments: Any) -> Any:
        """End the node, unless the one that it replaces has caused the request."""
        if any(REASON in str(argument) for argument in arguments) and self.succession.ignores(self.uri):
            return 1, "ignored", 0
        return super().shutdown(*arguments)

    def give_way(self) -> None:
        """End the node, on a thread of its own, for a newer one if the master's request did not arrive."""
        arguments = (self, "/master", f"[{self.name}] Reason: {REASON}")
        threading.Thread(target=ROSHandler.shutdown, args=arguments, daemon=True).start()
