"""docs/security.md: the listed ports are those that listen, and the firewall admits only the partner."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from rosafe.interface import MAX_SETUP
from rosafe.interface.rosafe import MAX_PARAMETERS
from rosafe.ros1.bass import socket_server
from rosafe.ros1.transport import handshake_server, received_data, server_limits
from rosafe.tree.setups import markup, reading
from rosafe.web.genomix import daemon, sessions
from rosafe.web.genomix import routes as api
from rosafe.web.live import client, server, views
from rosafe.web.server import connections
from tests.harness import PYTHON, ROOT, Graph, MasterProcess, free_port, proc
from tests.networks import networks
from tests.web.genomix.world import Http, genomixd
from tests.web.live.world import live
from tests.web.server.test_limits import MEMORY

PAGE = (ROOT / "docs" / "security.md").read_text("utf-8")
LISTENING = "0A"
LOOPBACK, EVERYWHERE = "127.0.0.1", "0.0.0.0"


def rows(heading: str) -> list[list[str]]:
    """Return the rows of the table under a heading of the page."""
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def documented(ros_address: str) -> dict[str, Counter[tuple[str, str]]]:
    """Return the documented sockets of each program, as counts by (port or `any`, address)."""
    found: dict[str, Counter[tuple[str, str]]] = {}
    for programs, _, port, address in rows("Listening ports"):
        where = ros_address if address == "by `ROS_IP`" else address.split()[0]
        for program in re.findall("`(.*?)`", programs):
            found.setdefault(program, Counter())[port.split()[0], where] += 1
    return found


def listening(pid: int, ports: dict[int, str]) -> Counter[tuple[str, str]]:
    """Return the sockets on which a process listens. `ports` are the names of fixed ports in the page."""
    inodes = set()
    for path in proc(pid, "fd").iterdir():
        try:
            inodes.add(path.readlink().name)
        except OSError:  # closed in the meantime
            continue
    found: Counter[tuple[str, str]] = Counter()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in proc("net", table).read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if f"socket:[{inode}]" in inodes and (state == LISTENING or table.startswith("udp")):
                address, port = local.split(":")
                assert len(address) == 8, f"not IPv4: {line}"
                name = socket.inet_ntoa(bytes.fromhex(address)[::-1])
                found[ports.get(int(port, 16), "any") if table == "tcp" else table, name] += 1
    return found


def own_address() -> str:
    """Return an address of this machine other than loopback. Without one, the test is skipped."""
    if shutil.which("ip") is None:
        pytest.skip("no command ip")
    shown = subprocess.run(["ip", "-4", "-o", "address"], capture_output=True, text=True, check=True).stdout
    found = [address for address in re.findall(r" inet ([\d.]+)/", shown) if not address.startswith("127.")]
    if not found:
        pytest.skip("this machine has no address but loopback")
    return str(found[0])


@pytest.mark.ros
@pytest.mark.forks
@pytest.mark.parametrize("setting", ["unset", "an address"])
def test_the_documented_sockets_listen(setting: str, tmp_path: Path) -> None:
    """Master, nodes, genomixd, the live page and the dedicated socket run together, as on a robot."""
    address = own_address() if setting == "an address" else LOOPBACK
    socket_port = free_port()
    master = MasterProcess()
    graph = Graph(f"http://{address}:{master.port}", tmp_path)
    graph.env["ROS_IP"] = address
    with ExitStack() as stack:
        stack.callback(master.kill)
        master.start(graph.env)
        if setting == "unset":  # with the defaults of our commands; the master is that of roscore
            del graph.env["ROS_IP"]
        nodes = {name: stack.enter_context(graph.node(name)) for name in ("bass-ros", "rosAFE-ros")}
        graph.run("rosparam", "set", "/bass/socket_port", str(socket_port))
        graph.run("rosservice", "call", "/bass/DedicatedSocket", "{}")
        nodes["genomixd"], http_port = stack.enter_context(genomixd(graph))
        assert Http(http_port).call("bass/Stop") == {}
        page = stack.enter_context(live(graph))
        nodes["rosafe live"] = page.process
        assert master.process is not None
        nodes["roscore"] = master.process
        expected = documented(LOOPBACK if address == LOOPBACK else EVERYWHERE)
        assert expected.keys() == nodes.keys()
        ports = {master.port: "11311", socket_port: "8081", http_port: "8080", page.port: "8090"}
        for name, process in nodes.items():
            assert listening(process.pid, ports) == expected[name], name
    assert (str(daemon.DEFAULT_PORT), daemon.DEFAULT_HOST) in expected["genomixd"]
    assert (str(socket_server.DEFAULT_PORT), socket_server.DEFAULT_HOST) in expected["bass-ros"]


def test_the_documented_limits() -> None:
    limits = [
        handshake_server.OPENING_SECONDS,
        handshake_server.MAX_PENDING,
        received_data.HEADER_BYTES,
        server_limits.BODY_BYTES,
        (handshake_server.DESCRIPTORS, handshake_server.RESERVE),
        "the longest valid one",
        (socket_server.MAX_CLIENTS, socket_server.IDLE_SECONDS),
        (api.LIMITS.max_connections, api.LIMITS.max_connections // 2),
        (api.LIMITS.request_seconds, connections.STALL_SECONDS),
        api.LIMITS.max_answers // 2**20,
        api.LIMITS.max_header_bytes // 2**20,
        (sessions.MAX_SESSIONS, sessions.MAX_REQUESTS),
        (f"{MAX_SETUP >> 20} MiB", markup.MAX_VALUES, 0),
        (MAX_PARAMETERS, reading.MAX_PARAMETER_VALUES),
        (server.MAX_CLIENTS, server.LIMITS.max_connections, server.LIMITS.max_connections // 2),
        (server.LIMITS.request_seconds, server.LIMITS.max_header_bytes // 2**20, MEMORY),
        (f"{client.MAX_MESSAGE >> 20} MiB", client.MAX_PENDING, client.MAX_VIEWS, views.MAX_VIEWS),
        (client.BYTES_PER_SECOND, 1 / client.PERIOD, client.STALL_SECONDS),
    ]
    shown = [
        "; ".join(f"{number:.0f}" if not isinstance(number, str) else number for number in numbers)
        for numbers in (entry if isinstance(entry, tuple) else (entry,) for entry in limits)
    ]
    assert [bound for *_, bound in rows("Limits")] == shown
    assert connections.BUFFER == 4 * 1024


# --- the firewall -----------------------------------------------------------------------------------------------

# Listens on ports of an address, until its input ends.
SERVER = """
import socket, sys
servers = [socket.create_server(("0.0.0.0", int(port))) for port in sys.argv[1:]]
print("up", flush=True)
sys.stdin.read()
"""
# Connects from one address to another; says whether that went.
CLIENT = """
import socket, sys
here, there, port, seconds = sys.argv[1:]
try:
    socket.create_connection((there, int(port)), float(seconds), (here, 0)).close()
    print("in")
except TimeoutError:
    print("out")
"""


@pytest.fixture
def robot() -> Iterator[str]:
    """A host in a network namespace with the address in the page, connected to the partner and other hosts."""
    if shutil.which("ip") is None or shutil.which("nft") is None:
        pytest.skip("network namespaces and firewalls need the commands ip and nft")
    number = free_port()
    robot, others = f"robot{number}", f"others{number}"
    commands = [
        f"netns add {robot}",
        f"netns add {others}",
        f"link add eth0 netns {robot} type veth peer name eth0 netns {others}",
        f"-n {robot} addr add 10.0.0.1/24 dev eth0",
        *(f"-n {others} addr add 10.0.0.{host}/24 dev eth0" for host in (2, 3)),
        *(f"-n {name} link set {device} up" for name in (robot, others) for device in ("lo", "eth0")),
    ]
    with networks(commands, robot, others):
        yield robot


def test_the_firewall_admits_only_the_partner(robot: str) -> None:
    (rules,) = re.findall(r"^```nft\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    inside, outside = (["ip", "netns", "exec", name] for name in (robot, robot.replace("robot", "others")))
    done = subprocess.run([*inside, "nft", "-f", "-"], input=rules, capture_output=True, text=True, check=False)
    if "not supported" in done.stderr or "Operation not permitted" in done.stderr:
        pytest.skip(f"no firewall here: {done.stderr}")
    assert done.returncode == 0, done.stderr
    ports = ("8080", "8081", "11311", "32768", "60999", "22")

    def reached(where: list[str], here: str, there: str, port: str, seconds: float) -> bool:
        command = [*where, PYTHON, "-c", CLIENT, here, there, port, str(seconds)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout == "in\n"

    server = [*inside, PYTHON, "-c", SERVER, *ports]
    with subprocess.Popen(server, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == "up\n"
        for port in ports:
            assert reached(outside, "10.0.0.2", "10.0.0.1", port, 30), port
            assert reached(inside, "127.0.0.1", "127.0.0.1", port, 30), port
            assert reached(outside, "10.0.0.3", "10.0.0.1", port, 30 if port == "22" else 0.5) == (port == "22"), port
        process.stdin.close()
