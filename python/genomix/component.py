"""Components: their services and ports as methods, with the parameters and documentation that genomixd reports."""

from __future__ import annotations

import contextlib
import difflib
import inspect
import json
import keyword
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from genomix.event import GenoMError
from genomix.request import Request, Status, warn

if TYPE_CHECKING:
    from genomix.client import Client

_OPTIONS = ("ack", "callback", "oneway")  # keywords beside the parameters


class Component:
    """A component of the ROS graph. Its services and ports are methods; `dir` and `help` list them.

    A service is called with nothing, with one dictionary of parameters, with values in order, with keywords, or with
    values and keywords. Missing parameters have their defaults. The call waits for the end and returns the outputs as
    a dictionary. An activity such as a processor ends when it is stopped: with ``ack=True`` the call returns a request
    as soon as the activity runs, with ``callback=function`` at once (the function is called with the request at its
    end), and with ``oneway=True`` it returns None at once. Ctrl-C during a call aborts the activity.

    A port is called with the name of an element (``rosAFE.ildPort("ild")``) and returns the newest message.

    Raises
    ------
    GenoMError
        The component has rejected the request, or cannot be reached.
    """

    def __init__(self, client: Client, about: dict[str, Any]) -> None:
        # No attribute may have the name of a service of any component.
        self.__about = about
        self.__doc__ = f"{about['component']}: {about.get('doc', '')}"
        for name, service in about["services"].items():
            self.__dict__[name] = _service(client, about, name, service)
        for name, port in about["ports"].items():
            self.__dict__[name] = _port(client, about, name, port)

    def __getattr__(self, name: str) -> Any:
        """Find aliases; AttributeError names the services and ports."""
        about = self.__dict__.get("_Component__about", {"services": {}, "ports": {}, "component": "component"})
        entries = {**about["services"], **about["ports"]}
        for known, entry in entries.items():
            if name in entry.get("aliases", ()):
                return self.__dict__[known]
        close = difflib.get_close_matches(name, entries, 1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise AttributeError(
            f"{about['component']}: expected a service or port ({', '.join(entries)}), got {name!r}{hint}"
        )

    def __dir__(self) -> list[str]:
        return [*self.__about["services"], *self.__about["ports"]]

    def __repr__(self) -> str:
        return f"<genomix.Component {label(self)}>"


def label(component: Component) -> str:
    """Return the name of a component in its session."""
    return str(component.__dict__["_Component__about"]["name"])


def _service(client: Client, about: dict[str, Any], name: str, service: dict[str, Any]) -> Callable[..., Any]:
    full_name = f"{about['name']}.{name}"
    form = {"syntax": "packed"} if about["component"] == "rosAFE" else {}  # JSON has no NaN, but exact integers
    place, where = f"{quote(about['name'], safe='')}/{quote(name)}", {"i": str(about["instance"])}

    def method(*args: Any, **kwargs: Any) -> Any:
        options = {word: kwargs.pop(word) for word in _OPTIONS if word in kwargs and word not in service["parameters"]}
        query = {**where, "input": _text(full_name, _arguments(full_name, service, args, kwargs))}
        if options.get("oneway"):
            client.send(f"/send/{place}", oneway="1", **query)
            return None
        ack, callback = options.get("ack"), options.get("callback")
        if not ack and not callback and not service["activity"]:
            return _outputs(full_name, client.get(f"/call/{place}", **query, **form))
        request = _sent(
            lambda: Request(client, full_name, client.send(f"/send/{place}", **query), form),
            lambda request: request.wait_for_start() if ack else None if callback else request.wait(),
        )
        if ack or not callback:
            request.show_warning()
        if (ack and request.status is Status.error) or not (ack or callback):
            return request.result or {}  # or raises its error
        if callback:
            request.notify(callback)
        return request

    _document(method, about, name, _service_help(full_name, service))
    method.__signature__ = _signature(service["parameters"])  # type: ignore[attr-defined]
    return method


def _sent(send: Callable[[], Request], wait: Callable[[Request], object]) -> Request:
    """Send a request and wait; an exception, such as Ctrl-C, aborts the activity.

    Another thread sends the request, because Ctrl-C does not interrupt that thread, and only the answer contains the
    number that `abort` needs.
    """
    sending: Future[Request] = Future()

    def work() -> None:
        if sending.set_running_or_notify_cancel():
            try:
                sending.set_result(send())
            except BaseException as problem:
                sending.set_exception(problem)

    try:
        threading.Thread(target=work, name="genomix", daemon=True).start()
        request = sending.result()
        wait(request)
    except BaseException:
        if not sending.cancel():
            with contextlib.suppress(GenoMError):
                sending.result().abort()
        raise
    return request


def _port(client: Client, about: dict[str, Any], name: str, port: dict[str, Any]) -> Callable[..., Any]:
    place = f"/call/{quote(about['name'], safe='')}/{quote(name)}"
    form = {"syntax": "packed"} if about["component"] == "rosAFE" else {}

    def method(element: str = "") -> Any:
        query = {"element": str(element)} if port["multiple"] else {}  # others ignore an element, as in the original
        return client.get(place, i=str(about["instance"]), **query, **form)

    direction = "Output" if port["output"] else "Input"
    _document(method, about, name, f"{direction} port, {port['type']}: {port['doc']}")
    return method


def _arguments(name: str, service: dict[str, Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Return the arguments of a call as an object, or as an array for requests with a free form."""
    parameters = service["parameters"]
    if len(args) == 1 and isinstance(args[0], dict):
        first = next(iter(parameters.values()), {"type": ""})
        if not str(first["type"]).startswith("::") or not args[0] or set(args[0]) & set(parameters):
            return _joined(name, args[0], kwargs)
    if service["composite"]:
        return [*args, kwargs] if kwargs else list(args)
    if not kwargs:
        return list(args)
    if len(args) > len(parameters):
        what = f"{name}: expected at most {len(parameters)} values, got {len(args)}"
        raise GenoMError("::genom::serialization", what=what)
    return _joined(name, dict(zip(parameters, args, strict=False)), kwargs)


def _joined(name: str, values: dict[str, Any], kwargs: dict[str, Any]) -> dict[str, Any]:
    twice = sorted(set(values) & set(kwargs))
    if twice:
        raise GenoMError("::genom::serialization", what=f"{name}: {twice[0]}: expected one value, got two")
    return {**values, **kwargs}


def _text(name: str, value: Any) -> str:
    try:
        return json.dumps(value, default=_plain)
    except (TypeError, ValueError) as problem:
        raise GenoMError("::genom::serialization", what=f"{name}: {problem}") from None


def _plain(value: Any) -> Any:
    """Return the list or number of an array, or the list of a set."""
    if hasattr(value, "tolist"):  # numpy
        return value.tolist()
    if isinstance(value, (set, frozenset, range)):
        return sorted(value)
    raise TypeError(f"expected numbers, texts, lists and dictionaries, got {type(value).__name__}")


def _outputs(name: str, outputs: dict[str, Any]) -> dict[str, Any]:
    if "warning" in outputs:
        warn(name, outputs.pop("warning"))
    return outputs


# --- documentation ----------------------------------------------------------------------------------------------


def _document(method: Any, about: dict[str, Any], name: str, text: str) -> None:
    method.__name__, method.__qualname__, method.__module__ = name, f"{about['name']}.{name}", "genomix"
    method.__doc__ = text


def _service_help(name: str, service: dict[str, Any]) -> str:
    lines = [service["doc"], ""]
    if service["activity"]:
        lines += [f"An activity: with ack=True, {name} returns when it runs; without, when it has ended.", ""]
    for parameter, about in service["parameters"].items():
        default = "required" if about["required"] else f"default {about['default']!r}"
        facts = "; ".join(fact for fact in (default, about["range"]) if fact)
        lines.append(f"    {parameter} ({about['type']}; {facts})")
        lines += [f"        {about['doc']}"] if about["doc"] else []
    if service["outputs"]:
        lines += ["", "Outputs: " + ", ".join(f"{word} ({kind})" for word, kind in service["outputs"].items())]
    if service["throws"]:
        lines += ["", "Exceptions: " + ", ".join(service["throws"])]
    return "\n".join(lines)


def _signature(parameters: dict[str, Any]) -> inspect.Signature:
    """Return the signature for `help` and completion. Required parameters have the default None."""
    listed = [
        inspect.Parameter(
            name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default=None if about["required"] else about["default"],
        )
        for name, about in parameters.items()
        if name.isidentifier() and not keyword.iskeyword(name)
    ]
    return inspect.Signature([*listed, inspect.Parameter("options", inspect.Parameter.VAR_KEYWORD)])
