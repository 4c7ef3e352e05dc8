"""What this node offers and reads, as the master should know it: told by a thread of its own, again where need be.

rospy tells the master from whichever thread makes or ends a topic, under its locks, without a limit of time, and once.
So a master that hangs would hold up the node, and one that was restarted would never hear of it. Here all is told by
one thread, in calls that are bounded, until the master knows it; a master that has forgotten the node is told anew.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
import xmlrpc.client
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import rosgraph.names
import rospy
import rospy.impl.init
import rospy.impl.paramserver
from rospy.impl.registration import (
    Registration,
    RegistrationListener,
    RegManager,
    get_registration_listeners,
    get_service_manager,
    get_topic_manager,
)

from rosafe.transport import master, paths, server_limits
from rosafe.transport.connector import Connector
from rosafe.transport.succession import NodeApiHandler, Succession

CHECK_SECONDS = 1.0  # between two looks whether the master still knows this node; between two tries without one
SETTLE_SECONDS = 1.0  # that a request waits for the master to know what it has changed
_LOG_TOPICS = "/rosout_disable_topics_generation"  # the parameter that rospy reads for each line of its log

_NOUNS = {Registration.PUB: "Publisher", Registration.SUB: "Subscriber", Registration.SRV: "Service"}


@dataclass(frozen=True, eq=False)
class _Registration:
    """One thing that was offered once: made again under the same name, it is another one."""

    kind: str
    name: str
    data: str  # the type of a topic, the address of a service


class Registrar(RegistrationListener):
    """Keeps the master informed. Made by `init_node`; rospy calls `reg_added` and `reg_removed`.

    Parameters
    ----------
    manager : rospy.impl.registration.RegManager
        rospy's own, which connects subscribers to the publishers that the master names.

    `end` is called when the node ends, after the hooks of `rospy.on_shutdown`.
    """

    def __init__(self, manager: RegManager) -> None:
        self.changes = 0  # so many times something was offered or withdrawn
        self.manager = manager
        self._name = rospy.get_name()
        self._succession: Succession = manager.handler.succession
        self._succession.on_contest = self._tell_all
        self._master: Any = master.proxy(manager.master_uri)
        self._pid: int | None = None  # of the master; None before it was asked
        self._turn = threading.Condition()
        self._offered: dict[tuple[str, str], _Registration] = {}
        self._last_reported: dict[tuple[str, str], _Registration] = {}  # what the master may know; of this thread alone
        self._settled = 0  # the master knows as much as after so many changes
        self._master_lost = False  # it did not answer the last time
        self._again = 1  # rounds in which all is told: a call that came to no end may have an effect later
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="registrar", daemon=True)

    # --- rospy tells what there is ---

    def reg_added(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        with self._turn:
            self._offered[reg_type, resolved_name] = _Registration(reg_type, resolved_name, data_type_or_uri)
            self._changed()

    def reg_removed(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        with self._turn:
            self._offered.pop((reg_type, resolved_name), None)
            self._changed()

    def _changed(self) -> None:
        self.changes += 1
        self._turn.notify_all()

    # --- for the node ---

    def start(self) -> None:
        """Begin, with what the master knows already."""
        topics, services = get_topic_manager(), get_service_manager()
        for kind, there in (
            (Registration.PUB, topics.get_publications()),
            (Registration.SUB, topics.get_subscriptions()),
            (Registration.SRV, services.get_services()),
        ):
            for name, data in there:
                self._offered[kind, name] = self._last_reported[kind, name] = _Registration(kind, name, data)
        self._thread.start()

    def settle(self, seconds: float = SETTLE_SECONDS) -> bool:
        """Wait until the master knows all that is offered now, but not for one that does not answer; whether it does.

        Not to be called under a lock that anything else needs.
        """
        with self._turn:
            wanted = self.changes
            self._turn.wait_for(lambda: self._settled >= wanted or self._master_lost or self._ended, seconds)
            return self._settled >= wanted

    def end(self, reason: str = "") -> None:
        """Register nothing more, and unregister what is no longer offered; rospy unregisters the rest."""
        with self._turn:
            self._ended = True
            self._turn.notify_all()
        if self._master_lost or not self._succession.turn.acquire(timeout=SETTLE_SECONDS):
            return
        self._succession.turn.release()  # the last call has returned
        farewell = xmlrpc.client.MultiCall(master.proxy(self.manager.master_uri))
        for key, entry in dict(self._last_reported).items():
            if self._offered.get(key) is not entry:
                getattr(farewell, f"unregister{_NOUNS[entry.kind]}")(self._name, entry.name, self._provider(entry))
        with contextlib.suppress(*master.FAILURES):
            farewell()

    def up(self) -> None:
        """Note that the node has started; rospy.ROSInitException if it was told to end before."""
        with self._succession.turn:
            self._succession.up = True
        if self._succession.over:
            raise rospy.ROSInitException(f"another node has started as {self._name} meanwhile")
        if rospy.core.is_shutdown_requested():
            raise rospy.ROSInitException("it was told to end")

    # --- the thread ---

    def _run(self) -> None:
        while not (self._ended or self._succession.over):
            with self._turn:
                self._turn.wait_for(
                    lambda: self._ended or (self._settled != self.changes and not self._master_lost), CHECK_SECONDS
                )
                changes, offered = self.changes, dict(self._offered)
            try:
                self._tell(offered)
            except master.FAILURES as problem:
                self._lost(problem)
            else:
                self._found(changes)

    def _tell(self, offered: dict[tuple[str, str], _Registration]) -> None:
        """Make the master know exactly `offered` of this node."""
        renewed = not self._is_known()
        if renewed:
            self._last_reported.clear()
        for entry in [e for key, e in self._last_reported.items() if offered.get(key) is not e]:
            self._call(f"unregister{_NOUNS[entry.kind]}", entry.name, self._provider(entry))
            del self._last_reported[entry.kind, entry.name]
        for key, entry in offered.items():
            if key not in self._last_reported or self._again:
                self._last_reported[key] = entry
                publishers = self._call(f"register{_NOUNS[entry.kind]}", entry.name, entry.data, self.manager.uri)
                if entry.kind == Registration.SUB:
                    self.manager.publisher_update(entry.name, publishers)
        if renewed and not self._ended:
            rospy.logwarn("the ROS master did not know this node (any more) and was told of it")

    def _is_known(self) -> bool:
        """Whether the master is the one of the last time, and knows this node."""
        (_, _, pid), (code, _, owner) = self._master.getPid(self._name), self._master.lookupNode(self._name, self._name)
        if code == 1 and self._succession.is_lost(owner, self.manager.uri):
            self.manager.handler.give_way()
            raise OSError("another node has the name")
        same = self._pid in (None, pid)
        self._pid = pid
        return same and code == 1 and owner == self.manager.uri

    def _call(self, method: str, *arguments: str) -> Any:
        with self._succession.turn:
            if self._ended or self._succession.over:
                raise OSError("the node ends")
            code, message, value = getattr(self._master, method)(self._name, *arguments)
        if code != 1:
            rospy.logerr(f"the ROS master refuses {method} of {arguments[0]}: {message}")
            return []
        return value

    def _provider(self, entry: _Registration) -> str:
        """The address under which `entry` is registered."""
        return entry.data if entry.kind == Registration.SRV else str(self.manager.uri)

    def _tell_all(self) -> None:
        """Register everything again: registrations may have been lost."""
        with self._turn:
            self._again = 2  # one round may be under way
            self._changed()

    def _lost(self, problem: Exception) -> None:
        with self._turn:
            first, self._master_lost, self._again = not self._master_lost, True, 2
            self._turn.notify_all()
        if first and not (self._ended or self._succession.over):
            rospy.logwarn(
                f"no answer from the ROS master at {self.manager.master_uri} ({master.reason(problem)}): what is "
                "connected goes on; what is new will be announced when it answers"
            )

    def _found(self, changes: int) -> None:
        with self._turn:
            back, self._master_lost, self._again = self._master_lost, False, max(0, self._again - 1)
            self._settled = changes
            self._turn.notify_all()
        if back:
            rospy.logwarn("the ROS master answers again")


_registrar: Registrar | None = None


def registrar() -> Registrar:
    """The one of this process; `init_node` has made it."""
    assert _registrar is not None
    return _registrar


def init_node(name: str, argv: list[str], anonymous: bool = False, unless_taken: bool = False) -> Registrar:
    """`rospy.init_node` for all nodes: without signal handlers, with our servers and calls of the master.

    Parameters
    ----------
    name : str
        Of the node, if `argv` has none.
    argv : list of str
        Program and remappings.
    anonymous : bool
        Append numbers to `name`, which make it unique.
    unless_taken : bool
        Append them if a node of this name runs, instead of ending that one.

    Raises
    ------
    rospy.ROSException, ValueError
        The node cannot start, or was told to end before it had started.
    """
    global _registrar
    server_limits.install()
    rospy.impl.init.ROSHandler = NodeApiHandler
    uri = master.uri()
    # All that rospy itself asks of the master, such as parameters, goes through this proxy.
    rospy.core._xmlrpc_cache[uri] = rospy.core._LockedServerProxy(uri, transport=master.Transport())
    try:
        _read_log_parameter()
        with _turn() if unless_taken else contextlib.nullcontext():
            anonymous = anonymous or (
                unless_taken and _is_taken(rosgraph.names.resolve_name(name, rospy.get_name()), uri)
            )
            rospy.init_node(name, argv=argv, anonymous=anonymous, disable_signals=True)
        listeners = get_registration_listeners()
        with listeners.lock:
            manager = next((one for one in listeners.listeners if isinstance(one, RegManager)), None)
            if manager is None:  # rospy removes it when the node ends
                raise rospy.ROSInitException("it was told to end")
            Connector(manager)
            _registrar = Registrar(manager)
            listeners.listeners[:] = [_registrar]
    except master.FAILURES as problem:
        raise rospy.ROSInitException(f"the ROS master at {uri} does not answer: {master.reason(problem)}") from None
    _let_registration_end_at_once(manager)
    rospy.core._preshutdown_hooks.insert(0, _registrar.end)  # before rospy's own, which unregisters what is offered
    _registrar.start()
    return _registrar


@contextlib.contextmanager
def _turn() -> Iterator[None]:
    """Let the servers of this user that start at the same moment find their names one after the other."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # without a temporary folder one of them may end the others
            folder = os.open(paths.private_temporary(), os.O_RDONLY)
            stack.callback(os.close, folder)
            fcntl.flock(folder, fcntl.LOCK_EX)  # given back by the kernel even if this process is killed
        yield


def _is_taken(name: str, uri: str) -> bool:
    """Return whether a node of that name answers."""
    address = master.node_address(uri, name)
    if address is None:
        return False
    try:
        with master.proxy(address) as node:
            node.getPid(name)
    except master.FAILURES:  # it was killed
        return False
    return True


def _read_log_parameter() -> None:
    """Read the parameter that rospy needs for each line of its log once, for good.

    rospy subscribes to it with each line, unless it is set. At the master a subscription counts as a registration:
    with its last lines, a node would take its name back from the one that has replaced it. It would also wait for the
    master.
    """
    code, _, value = rospy.get_master().getParam(_LOG_TOPICS)
    rospy.impl.paramserver.get_param_server_cache().set(_LOG_TOPICS, value if code == 1 else False)


def _let_registration_end_at_once(manager: RegManager) -> None:
    """Wake rospy's registration thread, for which rospy waits at the end, once it can see that it is to end.

    rospy itself wakes it before it raises the flag, and the thread then looks again half a second later.
    """

    def wake(reason: str) -> None:
        with manager.cond:
            manager.cond.notify_all()

    rospy.core.add_shutdown_hook(wake)
