"""Runs the live page: the graph, the server, the browser, a clean end."""

from __future__ import annotations

import asyncio
import errno
import gc
import html
import os
import signal
import sys
import tempfile
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rosafe.client.graph import Graph
from rosafe.component import startup
from rosafe.http_server.access import own_names
from rosafe.live.access import TokenAuth
from rosafe.live.components import ComponentFacade
from rosafe.live.health import Health
from rosafe.live.server import WebServer
from rosafe.live.views import Hub

THREADS = 8  # that wait for rospy
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "": "127.0.0.1"}  # and where this machine finds itself then


@dataclass(frozen=True)
class Options:
    """What `rosafe live` was told."""

    port: int
    host: str
    browser: bool
    watch: bool
    instance: str
    bass: str
    images: bool = False


class AddressInUse(Exception):
    """The server cannot listen; the text is one line that says why and what to do."""


async def serve(options: Options) -> None:
    """Serve until a signal arrives; raise AddressInUse, or ComponentError where there is no master."""
    loop = asyncio.get_running_loop()
    end = asyncio.Event()
    for number in startup.ending_signals():
        loop.add_signal_handler(number, end.set)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    loop.set_default_executor(ThreadPoolExecutor(THREADS, "rospy"))
    graph = Graph(os.environ["ROS_MASTER_URI"], "rosafe_live", server=True)
    robot = ComponentFacade(graph, options.instance, options.bass)
    server: WebServer | None = None
    opened: Path | None = None
    publishing: asyncio.Task[None] | None = None
    try:

        def tell_news() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(news)

        hub = Hub(robot.audio_topic, tell_news)
        door = TokenAuth(own_names() | {options.host})
        asks = {
            "devices": robot.devices,
            "acquire": robot.acquire,
            "silence": robot.stop_capture,
            "build": robot.build,
            "usual": robot.build_default_tree,
            "modify": robot.modify,
            "remove": robot.remove,
            "save": robot.save_setup,
            "load": robot.load_setup,
        }
        server = WebServer(robot, hub, Health(options.instance, options.bass), door, asks, options.watch)
        news = server.news
        try:
            port = await server.start(options.host, options.port)
        except (OSError, UnicodeError) as problem:
            raise AddressInUse(_why(problem, options)) from None
        await graph.become_node()  # not before: another page of this name ends then
        shown = EVERYWHERE.get(options.host, f"[{options.host}]" if ":" in options.host else options.host)
        url = f"http://{shown}:{port}/?token={door.token}"
        print(f"The live page is at\n\n    {url}\n\nWho has this address may use it. Ctrl-C ends it.", flush=True)
        if options.browser and _has_display():
            opened = await asyncio.to_thread(_open, url)
        gc.freeze()
        sys.setswitchinterval(startup.SWITCH_SECONDS)  # to parse a setup, in a thread, must not hold up the pages
        if options.images:
            publishing = asyncio.create_task(_publish_images(hub, server))
        waits = [asyncio.create_task(event.wait()) for event in (end, graph.gone)]
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        startup.watchdog(startup.END_SECONDS, 0)
        if publishing is not None:
            publishing.cancel()
        if opened is not None:
            opened.unlink(missing_ok=True)
        if server is not None:
            await server.close()
        await robot.close()
        await graph.close()


async def _publish_images(hub: Hub, server: WebServer) -> None:
    from rosafe.live import image_topics  # matplotlib's colours take a moment

    lookers = await asyncio.to_thread(image_topics.Images, hub)
    while True:
        if lookers.wanted:
            server.join(lookers)
            await lookers.publish()
        else:
            await lookers.publish()  # lets go
            server.leave(lookers)
        await asyncio.sleep(image_topics.PERIOD)


def _why(problem: OSError | UnicodeError, options: Options) -> str:
    place = f"port {options.port} of {options.host}"
    number = getattr(problem, "errno", None)
    if number == errno.EADDRINUSE:
        return f"{place} is taken, perhaps by another rosafe live; --port chooses another"
    if number == errno.EACCES:
        return f"{place} is not for this user; --port chooses another"
    if number in (errno.EADDRNOTAVAIL, None):
        return f"{options.host} is no address of this machine; --host names one, such as 0.0.0.0 for all"
    return f"cannot listen on {place}: {getattr(problem, 'strerror', None) or problem}"


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open(url: str) -> Path | None:
    """Open the browser, by a file that only this user reads: command lines, with the token, are for all to see."""
    descriptor, name = tempfile.mkstemp(prefix="rosafe-live-", suffix=".html")
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
        stream.write(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={html.escape(url)}">\n')
    try:
        if webbrowser.open(Path(name).as_uri()):
            return Path(name)
    except webbrowser.Error:
        pass
    print("no browser could be opened; open the address in one", file=sys.stderr)
    os.unlink(name)
    return None
