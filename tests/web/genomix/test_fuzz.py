"""Random invalid requests to a running genomixd: it names the error, never crashes and does not grow.

GENOMIX_FUZZ=SECONDS sets the duration:
``GENOMIX_FUZZ=600 python3 -m pytest tests/web/genomix/test_fuzz.py --timeout=0``.
"""

from __future__ import annotations

import http.client
import json
import os
import time
from urllib.parse import quote, quote_plus

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosafe import interface
from tests.harness import PATIENCE, proc
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

LONG = float(os.environ.get("GENOMIX_FUZZ", "0"))

# Four connections to each of 26 services, and four topics of each of 10 actions, when all were used.
# sockets between genomixd and the components that it has loaded: of five topics for each activity, both ways, and more
LINKS = 9 * sum(len(component.activities) for component in interface.COMPONENTS.values())
MAX_FILES = 100 + LINKS

texts = st.text(max_size=20)
services = [f"{c.name}/{s.name}" for c, s in interface.all_services() if s.name != "kill"]
ports = [f"{c.name}/{p.name}" for c in interface.COMPONENTS.values() for p in c.ports]
names = sorted({p.name for _, s in interface.all_services() for p in s.parameters})
paths = st.one_of(
    st.sampled_from([f"/{verb}/{target}" for verb in ("call", "send") for target in services + ports]),
    st.builds(
        "/{}/{}/{}".format, st.sampled_from(["call", "send"]), st.sampled_from(["rosAFE", "bass"]), texts.map(quote)
    ),
    st.builds("/call/rosAFE/ildPort/{}".format, texts.map(quote)),
    st.builds("/load/rosAFE?i={}&as={}".format, texts.map(quote_plus), texts.map(quote_plus)),
    st.sampled_from(
        ["/", "/components", "/requests", "/rpath", "/session/start", "/session/stop", "/unload/bass", "/describe/bass"]
        + [f"/request/{verb}" for verb in ("status", "result", "abort", "clean")]
    ),
    st.lists(texts.map(lambda text: quote(text, safe="")), max_size=4).map(lambda parts: "/" + "/".join(parts)),
)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(names) | texts, inner, max_size=4),
    max_leaves=8,
)
inputs = values.map(json.dumps) | texts
keys = st.sampled_from(["s", "syntax", "input", "argv", "id", "ack", "oneway", "element", "i", "as", "ms", "dir"])
queries = st.lists(
    st.one_of(
        st.tuples(st.just("input"), inputs),
        st.tuples(st.just("syntax"), st.sampled_from(["json", "tcl"])),
        st.tuples(st.just("s"), st.sampled_from(["a", "b"])),
        st.tuples(st.just("id"), st.integers(1, 50).map("rosAFE::{}".format)),
        st.tuples(keys, texts),
    ),
    max_size=4,
)


@pytest.mark.timeout(int(LONG) + 600)
def test_random_text_is_rejected(world: World) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", world.port, timeout=PATIENCE)
    end = time.monotonic() + LONG
    world.http.call("rosAFE/connect_port", ["Audio", "bass/Audio"])

    @settings(
        max_examples=400 if LONG else 100,
        derandomize=not LONG,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(paths, queries)
    def throw(path: str, query: list[tuple[str, str]]) -> None:
        if path.split("?")[0].split("/")[-1] in ("kill", "listen", "wait"):
            return
        text = "&".join(f"{quote_plus(k)}={quote_plus(v, errors='replace')}" for k, v in query)
        connection.request("GET", f"{path}{'&' if '?' in path else '?'}{text}")
        response = connection.getresponse()
        body = response.read()
        assert response.status in (200, 400, 404, 409, 422, 502, 503), (path, query, response.status, body[:300])
        if response.status != 200 and b"syntax=tcl" not in text.encode():
            error = json.loads(body)
            assert error["ex"].startswith("::")
            assert error["ex"] != "::genom::unkex", (path, query, error)

    memory = resident(world.server.pid)
    throw()
    while time.monotonic() < end:
        throw()
    connection.close()
    assert world.server.alive
    assert "Traceback" not in world.server.err
    assert world.http.call("bass/Stop") == {}
    assert open_files(world.server.pid) < MAX_FILES
    assert resident(world.server.pid) < memory + 200


def open_files(pid: int) -> int:
    """Return the number of open files and sockets of a process."""
    return len(list(proc(pid, "fd").iterdir()))


def resident(pid: int) -> int:
    """Return the memory of a process in MB."""
    for line in proc(pid, "status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) // 1024
    raise AssertionError(f"no process {pid}")
