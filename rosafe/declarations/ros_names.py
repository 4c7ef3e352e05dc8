"""Names of topics and nodes in the namespace of a node, without ROS."""

from __future__ import annotations

from rosafe.declarations.representation import Representation


def resolve(name: str, node: str) -> str:
    """Return the full name for a `name` that is relative to the namespace of `node`, a full name.

    >>> resolve("bass/Audio", "/robot1/rosAFE"), resolve("/bass/Audio", "/robot1/rosAFE")
    ('/robot1/bass/Audio', '/bass/Audio')
    """
    return name if name.startswith("/") else f"{node.rpartition('/')[0]}/{name}"


def relative(name: str, node: str) -> str:
    """Return the shortest name that `resolve` maps to the full `name`.

    >>> relative("/robot1/bass/Audio", "/robot1/rosAFE"), relative("/bass/Audio", "/robot1/rosAFE")
    ('bass/Audio', '/bass/Audio')
    """
    return name.removeprefix(f"{node.rpartition('/')[0]}/")


def port_topic(node: str, kind: Representation, name: str) -> str:
    """Return the topic of the processor `name` of a `kind`; only the input has no name in its topic."""
    return f"{node}/{kind.port}" + (f"/{name}" if kind.parent else "")
