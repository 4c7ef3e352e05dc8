"""Starts Python programs as forks of a process that has imported their modules, which saves most start-up time.

Each test process starts one server with its first program. The server has one thread. For each program it imports the
modules of `MODULES`, once, and forks. The child has its own session, environment and streams, runs the script of the
program, and ends like any Python process. Tests of the start itself, and all programs whose environment affects imports
or the interpreter, use new processes (see `can_fork`).
"""

from __future__ import annotations

import array
import atexit
import contextlib
import ctypes
import functools
import gc
import importlib
import io
import json
import os
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PYTHON = "/usr/bin/python3"
NODES = ("rospy", "actionlib", "diagnostic_msgs.msg", "rosafe.ros1.transport.registration", "scipy.signal")
MODULES: Mapping[str, Sequence[str]] = {
    "rosAFE-ros": ("rosafe.ros1.afe.node", *NODES),
    "bass-ros": ("rosafe.ros1.bass.node", "rosafe.audio.devices.scene", *NODES),
    "genomixd": ("rosafe.web.genomix.daemon", *NODES),
    "rosafe": ("rosafe.commands.__main__",),
    "rosmsg": ("rosmsg", "rospy"),
    "rosnode": ("rosnode", "rospy"),
    "rosparam": ("rosparam",),
    "rosservice": ("rosservice", "rospy"),
    "rossrv": ("rosmsg", "rospy"),
    "rostopic": ("rostopic", "rospy"),
    "rosmaster": ("rosmaster", "rosmaster.main"),
}
_SOUNDS = ("scipy.signal", "soundfile")
_OFFLINE = (*_SOUNDS, "rosafe.processing.files", "rosafe.processing.sounds")
COMMANDS: Mapping[str, Sequence[str]] = {  # what commands of `rosafe` import when they run
    "doctor": _SOUNDS,
    "enhance": _OFFLINE,
    "localize": (*_OFFLINE, "rosafe.ros1.localizer.node", *NODES),
    "plot": (*_OFFLINE, "matplotlib.figure", "matplotlib.backends.backend_agg"),
    "process": (*_OFFLINE, "h5py"),
    "record": (*_SOUNDS, "rosafe.ros1.bass.recording", "rosafe.audio.devices.scene"),
    "trace": _OFFLINE,
}
SCRIPTS = {name: ROOT / "scripts" / name for name in ("rosAFE-ros", "bass-ros", "genomixd", "rosafe")}
_IMPORTS = ("PYTHON", "ROSAFE_", "COVERAGE_", "LD_", "LC_", "LANG", "ROS_NAMESPACE", "OMP_", "OPENBLAS_")
_HARMLESS = ("PYTHONPATH", "PYTHONUNBUFFERED", "PYTHONDONTWRITEBYTECODE")  # a fork observes the first two
_PR_SET_PDEATHSIG = 1
_NUMBER = struct.Struct("i")
_ENV = dict(os.environ)  # of the server, also if a test changes os.environ before the server starts


def _affecting_imports(env: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in env.items() if name.startswith(_IMPORTS) and name not in _HARMLESS}


def script_of(command: Sequence[str]) -> Path | None:
    """Return the script of a known program, or None."""
    name = os.path.basename(command[0])
    script = SCRIPTS.get(name, Path("/usr/bin", name))
    return script if name in MODULES and command[0] in (name, str(script)) and script.exists() else None


def can_fork(command: Sequence[str], env: Mapping[str, str], messages: str) -> bool:
    """Return whether `command` is a program that behaves the same as a fork; `messages` is the usual PYTHONPATH."""
    return (
        script_of(command) is not None
        and not any(":=" in argument for argument in command)  # rospy reads the command line when it is imported
        and not {"-b", "--background"} & set(command)  # such a program outlives the test process
        and env.get("PYTHONPATH", messages) == messages
        and _affecting_imports(_ENV) == _affecting_imports(env)
    )


def restore_environment() -> None:
    """Give the variables of this process that affect imports their first values."""
    first, now = _affecting_imports(_ENV), _affecting_imports(os.environ)
    if first != now:
        for name in now.keys() - first.keys():
            del os.environ[name]
        os.environ.update(first)


class ForkedProcess:
    """A program started by the server, with the methods of `subprocess.Popen` that the tests use."""

    def __init__(self, pid: int, status: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._status = status  # a pipe, to which the server writes the exit status
        self._lock = threading.Lock()

    def poll(self) -> int | None:
        """Return the exit code if the process has ended."""
        return self._result(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code; TimeoutExpired if the process does not end in time."""
        code = self._result(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # meanwhile
                os.kill(self.pid, number)

    def _result(self, timeout: float | None) -> int | None:
        with self._lock:
            if self.returncode is None and select.select([self._status], [], [], timeout)[0]:
                answer = os.read(self._status, _NUMBER.size)
                os.close(self._status)
                self.returncode = _NUMBER.unpack(answer)[0] if answer else -signal.SIGKILL  # the server was killed
            return self.returncode


class ForkServer:
    """The client of a server, which it starts; the kernel ends the server with this process."""

    def __init__(self) -> None:
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        env = dict(_ENV)
        if "COVERAGE_PROCESS_START" not in env:  # scripts/test --coverage measures from PYTHONPATH on
            env.pop("PYTHONPATH", None)
        with other:
            self._process = subprocess.Popen(
                ["setpriv", "--pdeathsig", "KILL", "--", PYTHON, "-m", "tests.fork_server", str(other.fileno())],
                cwd=ROOT,
                env=env,
                pass_fds=[other.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def start(
        self, command: Sequence[str], env: Mapping[str, str], cwd: Path | None, streams: Sequence[int]
    ) -> ForkedProcess:
        """Start a program; `streams` are the descriptors of its standard streams."""
        script = script_of(command)
        request = {"argv": [str(script), *command[1:]], "env": dict(env), "cwd": str(cwd or os.getcwd())}
        status, server_end = os.pipe()
        try:
            rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [*streams, server_end]))
            self._socket.sendmsg([json.dumps(request).encode()], [rights])
        finally:
            os.close(server_end)
        answer = os.read(status, _NUMBER.size)
        if not answer:
            raise RuntimeError(f"the server of forks has ended: {self._process.wait()}")
        return ForkedProcess(_NUMBER.unpack(answer)[0], status)

    def run(
        self, command: Sequence[str], env: Mapping[str, str], cwd: Path | None, stdin: str, timeout: float
    ) -> subprocess.CompletedProcess[str]:
        """Run a program, like `subprocess.run` with pipes; TimeoutExpired if it does not end in time."""
        (given, feed), *results = (os.pipe() for _ in range(3))
        try:
            process = self.start(command, env, cwd, [given, *(writer for _, writer in results)])
        finally:
            for descriptor in (given, *(writer for _, writer in results)):
                os.close(descriptor)
        output = ["", ""]

        def write() -> None:
            with contextlib.suppress(BrokenPipeError), open(feed, "w") as pipe:
                pipe.write(stdin)

        def read(index: int) -> None:
            with open(results[index][0], errors="replace") as pipe:
                output[index] = pipe.read()

        threads = [threading.Thread(target=write), *(threading.Thread(target=read, args=(i,)) for i in range(2))]
        for thread in threads:
            thread.start()
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        finally:
            for thread in threads:
                thread.join()
        assert process.returncode is not None
        return subprocess.CompletedProcess(list(command), process.returncode, *output)

    def close(self) -> None:
        """End the server; programs that still run are killed."""
        self._socket.close()
        self._process.wait()


@functools.cache
def shared() -> ForkServer:
    """Return the server of this process."""
    server = ForkServer()
    atexit.register(server.close)
    return server


# --- the server -----------------------------------------------------------------------------------------------------


def _serve(requests: socket.socket) -> dict[str, Any]:
    """Fork a child for each request until the client ends. Return in each child, with its request."""
    base_path = [entry for entry in sys.path if entry != str(ROOT)]
    running: dict[int, tuple[int, int]] = {}  # from the pidfd to process id and status pipe
    poll = select.poll()
    poll.register(requests, select.POLLIN)
    while True:
        for descriptor, _ in poll.poll():
            if descriptor in running:
                pid, status = running.pop(descriptor)
                poll.unregister(descriptor)
                os.close(descriptor)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with contextlib.suppress(BrokenPipeError):  # the client does not wait for it
                    os.write(status, _NUMBER.pack(code))
                os.close(status)
                continue
            data, ancillary, _, _ = requests.recvmsg(2**20, socket.CMSG_SPACE(4 * _NUMBER.size))
            if not data:
                sys.exit()
            request = json.loads(data)
            received = array.array("i", ancillary[0][2])
            _import(request["argv"])
            gc.freeze()  # a collection in a child would write to, and therefore copy, the memory of all modules
            pid = os.fork()
            if pid == 0:
                requests.close()
                for opened in (*running, *(status for _, status in running.values()), received[3]):
                    os.close(opened)
                _become(request, received[:3], base_path)
                return dict(request)
            for stream in received[:3]:
                os.close(stream)
            opened = os.pidfd_open(pid)
            running[opened] = pid, received[3]
            poll.register(opened, select.POLLIN)
            os.write(received[3], _NUMBER.pack(pid))


def _import(argv: Sequence[str]) -> None:
    """Import the modules of a program, and of a subcommand of `rosafe`."""
    name = os.path.basename(argv[0])
    modules = list(MODULES[name])
    if name == "rosafe" and len(argv) > 1 and argv[1].replace("-", "").isalnum():
        modules += (f"rosafe.commands.{argv[1].replace('-', '_')}", *COMMANDS.get(argv[1], ()))
    for module in modules:
        with contextlib.suppress(ModuleNotFoundError):  # the program reports it
            importlib.import_module(module)


def _become(request: Mapping[str, Any], streams: Sequence[int], base_path: Sequence[str]) -> None:
    """Give this process the streams, environment and import path of a new one."""
    os.setsid()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    sys.stdout.flush()
    sys.stderr.flush()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.environ.clear()
    os.environ.update(request["env"])
    time.tzset()
    os.chdir(request["cwd"])
    script = Path(request["argv"][0]).resolve()
    messages = [entry for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    sys.path[:] = [str(script.parent), *messages, *base_path]
    sys.argv[:] = request["argv"]
    sys.stdin = open(0, errors=sys.stdin.errors, closefd=False)  # noqa: SIM115  # as long as the process
    unbuffered = bool(os.environ.get("PYTHONUNBUFFERED"))
    binary = open(1, "wb", buffering=0 if unbuffered else -1, closefd=False)  # noqa: SIM115
    sys.stdout = io.TextIOWrapper(binary, errors=sys.stdout.errors, write_through=unbuffered)
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115


def _run(script: str) -> None:
    """Run a script and end the process without deleting the imported modules, which takes longer than most programs."""
    status = 0
    try:
        runpy.run_path(script, run_name="__main__")
    except SystemExit as end:
        if isinstance(end.code, str):
            raise
        status = end.code or 0
    threading._shutdown()  # type: ignore[attr-defined]  # as Python does at the end: wait for threads, ...
    atexit._run_exitfuncs()  # ... call the registered functions, ...
    try:
        sys.stdout.flush()  # ... and write the rest of the output
        sys.stderr.flush()
    except OSError:
        sys.exit(status)  # Python reports it
    os._exit(status & 0xFF)


if __name__ == "__main__":
    program = _serve(socket.socket(fileno=int(sys.argv[1])))
    _run(program["argv"][0])
