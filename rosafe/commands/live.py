"""Show and control a running bass and rosAFE in a browser.

Prints a URL with a token. The page shows the cochleagrams of both ears, level differences, the direction of the source,
levels, losses and loads. It can add representations, change parameters, and start and stop the sound. All files come
from this server, so that no Internet access is needed. The server joins the ROS graph of bass and rosAFE, and
subscribes only to ports that are displayed.

examples:
  rosafe live
  rosafe live --host 0.0.0.0 --watch --no-browser    # for the network of the robot; see docs/security.md"""

from __future__ import annotations

import argparse
import asyncio

from rosafe.commands import CommandError
from rosafe.commands._component import add_instance, prepare
from rosafe.system import option_types


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "--port", type=option_types.port(), default=8090, help="TCP port (default: 8090; 0: any free port)"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to listen on (default: 127.0.0.1, this machine only; 0.0.0.0: all)",
    )
    parser.add_argument("--no-browser", action="store_true", help="do not open a browser")
    parser.add_argument("--watch", action="store_true", help="read-only page")
    parser.add_argument("--images", action="store_true", help="also publish images for rviz (sensor_msgs/Image)")
    add_instance(parser)
    parser.add_argument("--bass", metavar="NAME", help="name of the bass node (default: bass beside the rosAFE node)")


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from rosafe.interface import ComponentError
    from rosafe.ros1.component import startup
    from rosafe.ros1.transport import master

    prepare()
    master.check_family()
    startup.ensure_log_directory()
    from rosafe.web.live import daemon
    from rosafe.web.server.listener import ListenError

    try:
        asyncio.run(daemon.serve(options))
    except (ComponentError, ListenError) as problem:
        raise CommandError(str(problem)) from None
    return 0
