"""Registration of this node's topics and services at the master, by one thread that repeats it if necessary.

rospy calls the master once, from any thread that creates or ends a topic, while it holds locks and without a time
limit. A master that hangs would therefore block the node, and a restarted master would never learn about the node. Here
one thread registers everything, in calls with a time limit, until the master has it; a restarted master gets all
registrations again.
"""

from __future__ import annotations

import contextlib
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

from rosafe.ros1.transport import master, paths, server_limits
from rosafe.ros1.transport.succession import MasterProxy, NodeApiHandler, Succession
from rosafe.system.output import lock_file

CHECK_SECONDS = 1.0  # between two checks of the registration at the master, and between two attempts to reach it
SETTLE_SECONDS = 1.0  # maximum time that a request waits until its changes are registered
_LOG_TOPICS = "/rosout_disable_topics_generation"  # the parameter that rospy reads for each log line

_NOUNS = {Registration.PUB: "Publisher", Registration.SUB: "Subscriber", Registration.SRV: "Service"}


@dataclass(frozen=True, eq=False)
class _Offer:
    """One offered topic or service. If it is offered again under the same name, that is a new object."""

    kind: str
    name: str
    data: str  # the type of a topic, the address of a service


class Registrar(RegistrationListener):
    """Keeps the registrations at the master up to date. Created by `init_node`; rospy calls the `reg_*` methods.

    `end` is called when the node ends, after the hooks of `rospy.on_shutdown`.

    Parameters
    ----------
    manager : rospy.impl.registration.RegManager
        rospy's manager, which connects subscribers to the publishers that the master lists.
    """

    def __init__(self, manager: RegManager) -> None:
        self.changes = 0  # number of changes of the offered topics and services
        self.manager = manager
        self._name = rospy.get_name()
        self.parameters: dict[str, Any] = {}  # ROS parameters by full name, which a restarted master gets again
        self._succession: Succession = manager.handler.succession
        self._succession.on_contest = self._register_all_again
        self._master: Any = master.proxy(manager.master_uri)
        self._pid: int | None = None  # of the master; None before the first call
        self._changed = threading.Condition()
        self._offered: dict[tuple[str, str], _Offer] = {}
        # Registrations that the master may have; only used by the thread, and before and after it.
        self._last_reported: dict[tuple[str, str], _Offer] = {}
        self._settled = 0  # the value of `changes` up to which the master is up to date
        self._master_lost = False  # it did not answer the last call
        self._full_rounds = 1  # rounds that register everything: an unfinished call may take effect later
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="registrar", daemon=True)

    # --- called by rospy ---

    def reg_added(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        with self._changed:
            self._offered[reg_type, resolved_name] = _Offer(reg_type, resolved_name, data_type_or_uri)
            self._count_change()

    def reg_removed(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        with self._changed:
            self._offered.pop((reg_type, resolved_name), None)
            self._count_change()

    def _count_change(self) -> None:
        self.changes += 1
        self._changed.notify_all()

    # --- for the node ---

    @property
    def is_replaced(self) -> bool:
        """Whether another node has taken the name of this one, which therefore ends."""
        return self._succession.over

    def start(self) -> None:
        """Start the thread; everything that exists now is already registered."""
        topics, services = get_topic_manager(), get_service_manager()
        for kind, offered in (
            (Registration.PUB, topics.get_publications()),
            (Registration.SUB, topics.get_subscriptions()),
            (Registration.SRV, services.get_services()),
        ):
            for name, data in offered:
                self._offered[kind, name] = self._last_reported[kind, name] = _Offer(kind, name, data)
        self._thread.start()

    def settle(self, seconds: float = SETTLE_SECONDS) -> bool:
        """Wait until everything offered now is registered, unless the master does not answer; return whether it is.

        The caller must not hold a lock that other threads need.
        """
        with self._changed:
            target = self.changes
            self._changed.wait_for(lambda: self._settled >= target or self._master_lost or self._ended, seconds)
            return self._settled >= target

    def end(self, reason: str = "") -> None:
        """Stop registering, and unregister everything that is no longer offered; rospy unregisters the rest.

        The last call must have returned, also if the one before it had no answer: the master would carry it out after
        rospy has unregistered everything.
        """
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if not self._succession.registration_lock.acquire(timeout=SETTLE_SECONDS):
            return
        self._succession.registration_lock.release()
        withdrawn = [entry for key, entry in self._last_reported.copy().items() if self._offered.get(key) is not entry]
        last_calls = xmlrpc.client.MultiCall(master.proxy(self.manager.master_uri, SETTLE_SECONDS))
        for entry in withdrawn:
            getattr(last_calls, f"unregister{_NOUNS[entry.kind]}")(self._name, entry.name, self._provider(entry))
        if withdrawn:
            with contextlib.suppress(*master.FAILURES):
                last_calls()

    def up(self) -> None:
        """Mark the node as started; rospy.ROSInitException if it was asked to end before."""
        with self._succession.registration_lock:
            self._succession.up = True
        if self._succession.over:
            raise rospy.ROSInitException(f"another node has started as {self._name} meanwhile")
        if rospy.core.is_shutdown_requested():
            raise rospy.ROSInitException("it was asked to end")

    # --- the thread ---

    def _run(self) -> None:
        while not (self._ended or self._succession.over):
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ended or (self._settled != self.changes and not self._master_lost), CHECK_SECONDS
                )
                changes, offered = self.changes, dict(self._offered)
            try:
                self._update_master(offered)
            except master.FAILURES as problem:
                self._on_failure(problem)
            else:
                self._on_success(changes)

    def _update_master(self, offered: dict[tuple[str, str], _Offer]) -> None:
        """Register exactly `offered` at the master."""
        forgotten = not self._is_known()
        if forgotten:
            self._last_reported.clear()
            for name in list(self.parameters):
                self._call("setParam", name, self.parameters.get(name))
        for entry in [e for key, e in self._last_reported.items() if offered.get(key) is not e]:
            self._call(f"unregister{_NOUNS[entry.kind]}", entry.name, self._provider(entry))
            del self._last_reported[entry.kind, entry.name]
        for key, entry in offered.items():
            if key not in self._last_reported or self._full_rounds:
                self._last_reported[key] = entry
                publishers = self._call(f"register{_NOUNS[entry.kind]}", entry.name, entry.data, self.manager.uri)
                if entry.kind == Registration.SUB:
                    self.manager.publisher_update(entry.name, publishers)
        if forgotten and not self._ended:
            rospy.logwarn("this node was not registered at the ROS master (any more), and has registered again")

    def _is_known(self) -> bool:
        """Return whether the master is still the same process, and this node is registered there."""
        (_, _, pid), (code, _, owner) = self._master.getPid(self._name), self._master.lookupNode(self._name, self._name)
        if code == 1 and self._succession.is_lost(owner, self.manager.uri):
            self.manager.handler.give_way()
            raise OSError("another node has the name")
        same = self._pid in (None, pid)
        self._pid = pid
        return same and code == 1 and owner == self.manager.uri

    def _call(self, method: str, *arguments: Any) -> Any:
        with self._succession.registration_lock:
            if self._ended or self._succession.over:
                raise OSError("the node ends")
            code, message, value = getattr(self._master, method)(self._name, *arguments)
        if code != 1:
            rospy.logerr(f"the ROS master rejected {method} of {arguments[0]}: {message}")
            return []
        return value

    def _provider(self, entry: _Offer) -> str:
        """Return the address under which `entry` is registered."""
        return entry.data if entry.kind == Registration.SRV else str(self.manager.uri)

    def _register_all_again(self) -> None:
        """Register everything again: registrations may have been lost."""
        with self._changed:
            self._full_rounds = 2  # one round may be in progress
            self._count_change()

    def _on_failure(self, problem: Exception) -> None:
        with self._changed:
            first, self._master_lost, self._full_rounds = not self._master_lost, True, 2
            self._changed.notify_all()
        if first and not (self._ended or self._succession.over):
            rospy.logwarn(
                f"no answer from the ROS master at {self.manager.master_uri} ({master.reason(problem)}): existing "
                "connections continue; changes will be registered when it answers"
            )

    def _on_success(self, changes: int) -> None:
        with self._changed:
            reconnected, self._master_lost = self._master_lost, False
            self._full_rounds = max(0, self._full_rounds - 1)
            self._settled = changes
            self._changed.notify_all()
        if reconnected:
            rospy.logwarn("the ROS master answers again")


_registrar: Registrar | None = None


def registrar() -> Registrar:
    """Return the registrar of this process, which `init_node` has created."""
    assert _registrar is not None
    return _registrar


def init_node(name: str, argv: list[str], anonymous: bool = False, unless_taken: bool = False) -> Registrar:
    """Call `rospy.init_node`, without signal handlers, and with this package's servers and calls of the master.

    Parameters
    ----------
    name : str
        Name of the node, if `argv` has none.
    argv : list of str
        Program and remappings.
    anonymous : bool
        Append numbers to `name`, which make it unique.
    unless_taken : bool
        Append them if a node of this name runs, instead of ending that node.

    Raises
    ------
    rospy.ROSException, ValueError
        If the node cannot start, or was asked to end before it had started.
    """
    global _registrar
    server_limits.install()
    uri = master.uri()
    # rospy's own calls of the master, such as for parameters and during its `init_node`, use this proxy.
    proxy = rospy.core._xmlrpc_cache[uri] = MasterProxy(uri, transport=master.Transport())

    def handler(name: str, master_uri: str) -> NodeApiHandler:
        created = NodeApiHandler(name, master_uri)
        proxy.succession = created.succession
        return created

    rospy.impl.init.ROSHandler = handler
    try:
        _read_log_parameter()
        with _user_lock() if unless_taken else contextlib.nullcontext():
            anonymous = anonymous or (
                unless_taken and _is_taken(rosgraph.names.resolve_name(name, rospy.get_name()), uri)
            )
            rospy.init_node(name, argv=argv, anonymous=anonymous, disable_signals=True)
        listeners = get_registration_listeners()
        with listeners.lock:
            manager = next((one for one in listeners.listeners if isinstance(one, RegManager)), None)
            if manager is None:  # rospy removes it when the node ends
                raise rospy.ROSInitException("it was asked to end")
            _registrar = Registrar(manager)
            listeners.listeners[:] = [_registrar]
    except master.FAILURES as problem:
        raise rospy.ROSInitException(f"the ROS master at {uri} does not answer: {master.reason(problem)}") from None
    _let_registration_end_at_once(manager)
    rospy.core._preshutdown_hooks.insert(0, _registrar.end)  # before rospy's hook, which unregisters everything offered
    _registrar.start()
    return _registrar


@contextlib.contextmanager
def _user_lock() -> Iterator[None]:
    """Hold a lock of this user, so that servers that start at the same time choose their names one at a time."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # without a temporary folder, one of them may end the others
            folder = os.open(paths.private_temporary(), os.O_RDONLY)
            stack.callback(os.close, folder)
            lock_file(folder, wait=True)  # the kernel releases it even if this process is killed
        yield


def _is_taken(name: str, uri: str) -> bool:
    """Return whether a node with this name answers."""
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
    """Read the parameter that rospy needs for each log line, once and for all.

    If it is unset, rospy subscribes to it with each line. For the master a subscription is a registration: with its
    last log lines, a node would take its name back from the node that has replaced it. It would also wait for the
    master.
    """
    code, _, value = rospy.get_master().getParam(_LOG_TOPICS)
    rospy.impl.paramserver.get_param_server_cache().set(_LOG_TOPICS, value if code == 1 else False)


def _let_registration_end_at_once(manager: RegManager) -> None:
    """Wake rospy's registration thread, for which rospy waits at the end, after the shutdown flag is set.

    rospy wakes it before it sets the flag, so that the thread would check it only half a second later.
    """

    def wake(reason: str) -> None:
        with manager.cond:
            manager.cond.notify_all()

    rospy.core.add_shutdown_hook(wake)
