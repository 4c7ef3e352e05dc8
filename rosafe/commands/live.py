"""Show what the robot hears in a browser, and let it be changed there.

Prints an address with a token; who has it sees both ears' cochleagrams, level differences, the direction of the
source, levels, losses and loads, and can add representations, change parameters, start and stop the sound. The page
is served from here: the network needs no Internet. It joins the ROS graph of bass and rosAFE, and subscribes to nothing
that nobody looks at."""

from __future__ import annotations

import argparse
import asyncio
import os

from rosafe.commands import CommandError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--port", type=_port, default=8090, help="TCP port (default: 8090; 0: a free one)")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to listen on (default: 127.0.0.1, this machine alone; 0.0.0.0: all)",
    )
    parser.add_argument("--no-browser", action="store_true", help="open no browser")
    parser.add_argument("--watch", action="store_true", help="a page that changes nothing")
    parser.add_argument("--images", action="store_true", help="publish pictures for rviz, too (sensor_msgs/Image)")
    parser.add_argument("-i", "--instance", default="rosAFE", metavar="NAME", help="of rosAFE's node (default: rosAFE)")
    parser.add_argument("--bass", default="bass", metavar="NAME", help="of bass' node (default: bass)")
    parser.epilog = (
        "examples:\n"
        "  rosafe live\n"
        "  rosafe live --host 0.0.0.0 --watch --no-browser    # for the robot's network; see docs/security.md"
    )


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text[:10]) <= 65535):
        raise argparse.ArgumentTypeError(f"{text!r} is no port: 0 to 65535")
    return int(text)


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from rosafe.component import generate, startup
    from rosafe.interface import ComponentError
    from rosafe.transport import master

    master.set_local_defaults()
    try:
        generate.ensure_messages()
        master.check_master(os.environ["ROS_MASTER_URI"])
        startup.ensure_log_directory()
        from rosafe.client.component_client import names
        from rosafe.live import daemon

        instance, bass = (names(name, name)[1] for name in (options.instance, options.bass))
        told = daemon.Options(
            options.port, options.host, not options.no_browser, options.watch, instance, bass, options.images
        )
        asyncio.run(daemon.serve(told))
    except (generate.GenerationError, master.MasterError) as problem:
        raise CommandError(str(problem)) from None
    except ComponentError as problem:
        raise CommandError(str(problem)) from None
    except daemon.AddressInUse as problem:
        raise CommandError(str(problem)) from None
    return 0
