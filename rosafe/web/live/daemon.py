"""The process of the live page: ROS graph, server, browser, clean shutdown."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import html
import os
import sys
import tempfile
import webbrowser
from argparse import Namespace
from pathlib import Path

from rosafe.declarations import ros_names
from rosafe.interface import BASS, ROSAFE
from rosafe.ros1.client.asyncio_tools import set_up_server, wait_any
from rosafe.ros1.client.component_client import names
from rosafe.ros1.client.graph import Graph
from rosafe.ros1.client.localizer import NODE
from rosafe.ros1.component import startup
from rosafe.web.live.access import TokenAuth
from rosafe.web.live.components import ComponentFacade
from rosafe.web.live.health import Health
from rosafe.web.live.server import WebServer
from rosafe.web.live.views import Hub
from rosafe.web.server.access import own_names

THREADS = 8  # for calls that block in rospy
LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "": "127.0.0.1"}  # for the URL if the server listens everywhere


async def serve(options: Namespace) -> None:
    """Serve until a signal arrives, with the options of `rosafe live`.

    Raise ListenError, or ComponentError without a master.
    """
    async with contextlib.AsyncExitStack() as cleanup:
        try:
            await _serve(options, cleanup)
        finally:
            startup.watchdog(startup.END_SECONDS, 0)


async def _serve(options: Namespace, cleanup: contextlib.AsyncExitStack) -> None:
    loop = asyncio.get_running_loop()
    end = set_up_server(THREADS)
    graph = Graph(os.environ["ROS_MASTER_URI"], "rosafe_live", server=True)
    cleanup.push_async_callback(graph.close)
    _, instance = await names(graph, ROSAFE.name, options.instance)
    afe = graph.resolve(instance)
    _, instance = await names(graph, BASS.name, options.bass or ros_names.resolve(BASS.name, afe))
    bass = graph.resolve(instance)
    localizer = ros_names.resolve(NODE, afe)
    components = ComponentFacade(graph, afe, bass)
    cleanup.push_async_callback(components.close)

    def on_new_columns() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(server.on_new_columns)

    hub = Hub(bass, localizer, on_new_columns)
    auth = TokenAuth(own_names() | {options.host})
    server = WebServer(components, hub, Health(afe, bass, localizer), auth, options.watch)
    cleanup.push_async_callback(server.close)
    port = await server.start(options.host, options.port)
    await graph.become_node()  # after the server listens, because this ends another page of the same name
    host = LOOPBACK.get(options.host, f"[{options.host}]" if ":" in options.host else options.host)
    url = f"http://{host}:{port}/?token={auth.token}"
    print(f"The live page is at\n\n    {url}\n\nAnyone with this URL has access. Press Ctrl-C to stop.", flush=True)
    if not options.no_browser and _has_display():
        opened = await asyncio.to_thread(_open_browser, url)
        cleanup.callback(opened.unlink, missing_ok=True)
    gc.freeze()
    sys.setswitchinterval(startup.SWITCH_SECONDS)  # parsing a setup in a thread must not block the pages
    if options.images:
        cleanup.callback(asyncio.create_task(_publish_images(hub, server)).cancel)
    await wait_any(end, graph.gone)


async def _publish_images(hub: Hub, server: WebServer) -> None:
    from rosafe.web.live import image_topics  # importing the colour maps of matplotlib takes a moment

    images = await asyncio.to_thread(image_topics.Images, hub)
    while True:
        server.set_background_polling(images.requested)
        await asyncio.to_thread(images.publish)
        await asyncio.sleep(image_topics.PERIOD)


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open_browser(url: str) -> Path:
    """Open the URL and return the temporary file that redirects to it.

    Only this user can read the file. The command line of the browser, which all users can read, has no token.
    """
    with tempfile.NamedTemporaryFile(
        "w", prefix="rosafe-live-", suffix=".html", delete=False, encoding="utf-8"
    ) as stream:
        stream.write(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={html.escape(url)}">\n')
    path = Path(stream.name)
    with contextlib.suppress(webbrowser.Error):
        if webbrowser.open(path.as_uri()):
            return path
    print("no browser could be opened; open the URL in one", file=sys.stderr)
    path.unlink()
    return path
