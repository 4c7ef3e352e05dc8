"""A private PulseAudio server with a null sink: a sound card for tests, which can be unplugged."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rosafe.ros1.transport import paths
from tests.harness import PATIENCE, Process, wait_for


class PulseServer:
    """A server whose null sink ALSA's PCM `pulse` captures. It can be started again after it was killed."""

    def __init__(self, folder: Path) -> None:
        if shutil.which("pulseaudio") is None:
            pytest.skip("no pulseaudio here: scripts/install --tests brings it")
        if not (paths.PYPI_DIR / "pyalsaaudio-0.11.0.dist-info").is_dir():
            pytest.skip("pyalsaaudio is not here: scripts/install brings it")
        self.folder = folder
        self._socket = folder / "pulse.sock"
        self.env: dict[str, Any] = {
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "HOME": str(folder),
            "XDG_RUNTIME_DIR": str(folder),
            "PULSE_RUNTIME_PATH": str(folder),
            "PULSE_SERVER": f"unix:{self._socket}",
            "PULSE_LATENCY_MSEC": "50",
        }
        self._process: Process | None = None

    def start(self) -> None:
        """Start the server and wait until it accepts connections."""
        self._process = Process(
            [
                *("pulseaudio", "-n", "--exit-idle-time=-1", "--daemonize=no", "--use-pid-file=no"),
                *("-L", f"module-native-protocol-unix auth-anonymous=1 socket={self._socket}"),
                *("-L", "module-null-sink sink_name=card rate=44100 format=s32le"),
            ],
            self.env,
        )
        wait_for(self._answers, what=lambda: f"PulseAudio: {self._process}")

    def _answers(self) -> bool:
        done = subprocess.run(["pactl", "info"], env=self.env, capture_output=True, timeout=PATIENCE, check=False)
        return done.returncode == 0

    def play(self, path: Path) -> Process:
        """Start to play a WAV file into the sink."""
        return Process(["paplay", "--latency-msec=500", str(path)], self.env)

    def kill(self) -> None:
        """Kill the server."""
        if self._process is not None:
            self._process.stop(9)
            self._process.close()
            self._process = None
        self._socket.unlink(missing_ok=True)
