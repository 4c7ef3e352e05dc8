"""Named mutations, small faults that tests must detect: `scripts/test --mutations [NAME...]`.

Each is applied to a temporary copy of the tree, in which the tests named with it run; there is one copy for each core.
A mutation survives if they pass, or if they fail without it, too.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PYTHON = "/usr/bin/python3"
TIMEOUT_SECONDS = 600  # for the tests of one mutation; a test that does not end detects it, too
PYTEST_FAILED = 1  # exit codes
TIMED_OUT = 124


class Mutation(NamedTuple):
    """A change of one place in a file, and arguments for pytest that select tests which detect it."""

    name: str
    path: str
    old: str
    new: str
    tests: str


def _of(folder: str) -> Callable[[str, str, str, str, str], Mutation]:
    return lambda name, path, old, new, tests: Mutation(name, f"{folder}/{path}", old, new, tests)


_audio, _commands, _declarations, _demo, _dsp, _eltclsh, _interface, _localization, _processing, _representations = (
    _of(f"rosafe/{folder}")
    for folder in (
        *("audio", "commands", "declarations", "demo", "dsp", "eltclsh", "interface", "localization", "processing"),
        "representations",
    )
)
_results, _ros1, _setups, _tree, _validation, _view, _web = (
    _of(f"rosafe/{folder}") for folder in ("results", "ros1", "setups", "tree", "validation", "view", "web")
)

MUTATIONS = (
    # --- bass: capture
    _ros1(
        "bass-lost-frames-not-counted",
        "bass/capture.py",
        "new = chunk.gap + chunk.samples.shape[1]",
        "new = chunk.samples.shape[1]",
        "tests/ros1/bass/test_capture.py",
    ),
    _ros1(
        "bass-writable-view",
        "bass/capture.py",
        "view.flags.writeable = False",
        "pass",
        "tests/ros1/bass/test_capture.py",
    ),
    _ros1(
        "bass-oldest-frame-off-by-one",
        "bass/socket_server.py",
        "oldest = max(0, last - length + 1)",
        "oldest = max(0, last - length)",
        "tests/ros1/bass/test_socket.py",
    ),
    _ros1(
        "bass-inbox-unlimited",
        "bass/socket_server.py",
        "    del inbox[: max(0, len(inbox) - _MAX_REQUEST)]\n",
        "",
        "tests/ros1/bass/test_socket.py",
    ),
    _ros1(
        "bass-always-defers-publishing",
        "bass/capture.py",
        "late * sample_rate > LATE_CHUNKS * frames_per_chunk and self._unpublished * 2 <= self._window.frames",
        "late * sample_rate > LATE_CHUNKS * frames_per_chunk",
        "tests/ros1/bass/test_capture.py",
    ),
    # --- client: requests of genomixd, the live page and Tcl
    _ros1(
        "client-parameter-given-twice",
        "client/values.py",
        "        if parameter.name in values:\n",
        "        if False:\n",
        "tests/web/genomix/test_values.py",
    ),
    _ros1(
        "client-missing-parameter",
        "client/values.py",
        "    if missing is not None:\n",
        "    if False:\n",
        "tests/web/genomix/test_values.py",
    ),
    _ros1(
        "client-range-not-checked",
        "client/values.py",
        "    if not parameter.checked_by_client:",
        "    if True:",
        "tests/web/genomix/test_values.py tests/ros1/client",
    ),
    _ros1(
        "client-too-many-arguments",
        "client/values.py",
        "    if len(text_args) > len(service.parameters):\n",
        "    if len(text_args) > len(service.parameters) + 1:\n",
        "tests/web/genomix/test_values.py",
    ),
    _ros1(
        "client-joins-after-the-end",
        "client/graph.py",
        "        self.gone.set()  # otherwise `join` may try again, without a session\n",
        "",
        "tests/web/genomix/test_node.py -k no_attempt",
    ),
    # --- commands
    _commands(
        "clock-rounds-down",
        "_meter.py",
        "divmod(round(seconds), 60)",
        "divmod(int(seconds), 60)",
        "tests/ros1/bass/test_recording.py",
    ),
    _commands(
        "meter-mark-of-wrong-ear",
        "_meter.py",
        "any(part.clipped[ear] for part in parts)",
        "any(part.clipped[0] for part in parts)",
        "tests/ros1/bass/test_recording.py",
    ),
    _commands(
        "up-localize-ignored",
        "up.py",
        "if of_setup is None and not options.localize and not options.head and options.mirror is None:",
        "if of_setup is None and not options.head and options.mirror is None:",
        "tests/commands/test_up.py -k without_a_setup",
    ),
    # --- component
    _ros1(
        "audio-rate-of-ended-acquisition",
        "component/audio.py",
        "while self.sample_rate == 0 or time.time() > self._current_until:",
        "while self.sample_rate == 0:",
        "tests/ros1/afe/test_audio_ring.py -k on_its_way",
    ),
    _ros1(
        "awaited-blocks-not-read",
        "component/audio.py",
        "return reader.position <= reader.awaited or now",
        "return now",
        "tests/ros1/afe/test_audio_ring.py -k unobserved",
    ),
    _ros1(
        "observed-blocks-combined",
        "component/audio.py",
        "return max(1, most if needed > most else math.ceil(needed))",
        "return max(1, most)",
        "tests/ros1/afe/test_audio_ring.py -k unobserved",
    ),
    _ros1(
        "early-stamp-ignored",
        "component/frame_clock.py",
        "if time < line.at(frame):",
        "if False:",
        "tests/ros1/afe/test_frame_time.py",
    ),
    _ros1(
        "plan-kept-for-a-new-subscriber",
        "component/audio.py",
        "reader.awaited, reader.planned = self._frames.newest, 0",
        "reader.awaited = self._frames.newest",
        "tests/ros1/afe/test_audio_ring.py -k unobserved",
    ),
    _ros1(
        "new-subscriber-forgotten",
        "afe/published_tree.py",
        "impl.on_subscribers_changed = self._ports.forget_subscribed",
        "impl.on_subscribers_changed = lambda: None",
        "tests/ros1/afe/test_ports.py -k short_blocks",
    ),
    _ros1(
        "clock-step-without-limit",
        "component/frame_clock.py",
        "step = min(STEP_SECONDS, SLEW * (frame - self._last_output.frame) / self._nominal)",
        "step = SLEW * (frame - self._last_output.frame) / self._nominal",
        "tests/ros1/afe/test_frame_time.py",
    ),
    _ros1(
        "clock-set-not-noticed",
        "component/frame_clock.py",
        "        if time < line.at(frame) - SET_SECONDS:\n            return True\n",
        "",
        "tests/ros1/afe/test_frame_time.py",
    ),
    _ros1(
        "audio-of-old-connection",
        "component/audio.py",
        "            if connection is not self._connection:\n                return\n",
        "",
        "tests/ros1/afe/test_audio_ring.py",
    ),
    _ros1(
        "audio-gap-closed",
        "component/audio.py",
        "                self._frames.append(np.zeros((2, lost), np.int32))\n",
        "                pass\n",
        "tests/ros1/afe/test_audio_ring.py",
    ),
    _ros1(
        "audio-dropped-not-counted",
        "component/audio.py",
        "            self.counters.dropped += unread\n",
        "",
        "tests/ros1/afe/test_audio_ring.py",
    ),
    _ros1(
        "audio-read-without-lock",
        "component/audio.py",
        "        with self._arrived:\n            if connection is not self._connection:",
        "        if True:\n            if connection is not self._connection:",
        "tests/ros1/afe/test_audio_ring.py tests/ros1/afe/test_races.py",
    ),
    _ros1(
        "activities-one-too-many",
        "component/activities.py",
        ">= MAX_ACTIVITIES - 1",
        ">= MAX_ACTIVITIES",
        "tests/ros1/afe/test_activities.py",
    ),
    _ros1(
        "activity-stays-after-failed-start",
        "component/activities.py",
        "                del self._live[activity.id]\n            raise ComponentError(",
        "                pass\n            raise ComponentError(",
        "tests/ros1/afe/test_activities.py",
    ),
    _ros1(
        "load-never-reset",
        "component/activities.py",
        "                self._busy, self._since = 0.0, now\n",
        "                self._since = now\n",
        "tests/ros1/afe/test_activities.py",
    ),
    # --- declarations
    _declarations(
        "parameter-open-minimum-allowed",
        "parameter.py",
        "or (self.open_minimum and number == low)",
        "or False",
        "tests/interface",
    ),
    _declarations(
        "parameter-maximum-not-checked",
        "parameter.py",
        "if below or (high is not None and number > high):",
        "if below:",
        "tests/interface",
    ),
    _declarations(
        "parameter-list-too-long",
        "parameter.py",
        "        if len(items) > self.most:\n",
        "        if False:\n",
        "tests/interface",
    ),
    _declarations("parameter-nan", "checks.py", "math.isfinite", "not math.isinf", "tests/interface"),
    # --- demo
    _demo(
        "demo-losses-not-counted",
        "recorder.py",
        "            recording.lost += lost\n",
        "",
        "tests/demo/test_recorder.py",
    ),
    _demo(
        "demo-same-message-twice",
        "recorder.py",
        "message.lastFrameIndex in (0, self._recording.index)",
        "message.lastFrameIndex == 0",
        "tests/demo/test_recorder.py",
    ),
    _demo(
        "demo-sigterm-not-handled",
        "command.py",
        "SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)",
        "SIGNALS = (signal.SIGINT, signal.SIGHUP)",
        "tests/demo/test_ends.py -k test_signal -m 'not exploration'",
    ),
    _demo(
        "demo-crash-of-node-not-noticed",
        "session.py",
        "            if child.has_ended() and not self._ending:\n",
        "            if False:\n",
        "tests/demo/test_ends.py -k crash -m 'not exploration'",
    ),
    # --- dsp
    _dsp(
        "frames-one-too-few",
        "framing.py",
        "return max(0, (samples - len(self.window)) // self.hop + 1)",
        "return max(0, (samples - len(self.window)) // self.hop)",
        "tests/dsp/test_blocks.py -k ild",
    ),
    _dsp(
        "hop-longer-than-window",
        "framing.py",
        "self.skip = 0 if kept > 0 else -kept",
        "self.skip = 0",
        "tests/dsp/test_blocks.py -k ild",
    ),
    _dsp(
        "framing-position-not-reset",
        "framing.py",
        "self._start = self._stop = self.skip = self.position = 0\n\n    def advance",
        "self._start = self._stop = self.skip = 0\n\n    def advance",
        "tests/dsp/test_blocks.py tests/dsp/test_changes.py tests/dsp/test_kernels.py -k 'not aarch64 and not nehalem'",
    ),
    _dsp(
        "copy-with-arrays-of-others",
        "copies.py",
        "vars(self).update(copy.deepcopy(state))",
        "vars(self).update(state)",
        "tests/processing/test_copies.py -k 'independently and band'",
    ),
    _dsp(
        "copy-with-the-address-of-the-original",
        "kernels/__init__.py",
        "return PinnedArray.of, (self.array,)",
        "return PinnedArray, (self.array, self.address)",
        "tests/processing/test_copies.py -k 'independently and deepcopy'",
    ),
    _dsp(
        "stage-change-not-atomic",
        "stage.py",
        "        tried = copy.copy(self)\n",
        "        tried = self\n",
        "tests/dsp/test_changes.py",
    ),
    _dsp(
        "stage-one-ear",
        "stage.py",
        'axes[0] != "ear" or len(array) == ears)',
        'axes[0] != "ear" or len(array) >= 1)',
        "tests/dsp/test_limits.py",
    ),
    _dsp(
        "pool-array-in-use",
        "buffer_pool.py",
        "memory = _idle[count].pop()",
        "memory = _idle[count][-1]",
        "tests/dsp/test_memory.py",
    ),
    _dsp(
        "kernel-ild-swapped-ears",
        "kernels/ild.c",
        "(right[i] + epsilon) / (left[i] + epsilon)",
        "(left[i] + epsilon) / (right[i] + epsilon)",
        "tests/dsp/test_kernels.py -k 'test_ild and not aarch64'",
    ),
    _dsp(
        "kernel-correlation-of-one-energy",
        "kernels/correlation.c",
        "root(energy[0] * energy[1] + all(epsilon))",
        "root(energy[0] * energy[0] + all(epsilon))",
        "tests/dsp/test_kernels.py -k 'test_cross_correlation and not aarch64'",
    ),
    _dsp(
        "kernel-reads-beyond-frame",
        "kernels/ild.c",
        "load_first(weights + t, n - t), sum[0]);",
        "load(weights + t), sum[0]);",
        "tests/dsp/test_sanitizers.py -m 'not soak and not exploration'",
    ),
    # --- eltclsh
    _eltclsh(
        "history-newest-lost",
        "history.py",
        "entries[max(0, len(entries) - self.size) :]",
        "entries[: self.size]",
        "tests/eltclsh/test_terminal.py -k history",
    ),
    _eltclsh("history-readable-by-all", "history.py", "0o600", "0o644", "tests/eltclsh/test_terminal.py -k history"),
    _eltclsh(
        "completion-after-first-match",
        "complete.py",
        'return matches[-1].end() if kind == "C" else 0',
        'return matches[0].end() if kind == "C" else 0',
        "tests/eltclsh/test_terminal.py -k tab_completes",
    ),
    # --- genomix
    _web(
        "session-not-in-order",
        "genomix/sessions.py",
        "if self.name and call.service is not None:",
        "if False:",
        "tests/web/genomix/test_sessions.py",
    ),
    _web(
        "session-events-unlimited",
        "genomix/sessions.py",
        "if queue.qsize() < MAX_EVENTS:",
        "if True:",
        "tests/web/genomix/test_sessions.py",
    ),
    _web(
        "session-expires-at-once",
        "genomix/sessions.py",
        "LINGER_SECONDS if self._listened else IDLE_SECONDS",
        "LINGER_SECONDS",
        "tests/web/genomix/test_sessions.py",
    ),
    _web(
        "packed-number-too-large",
        "genomix/binary_format.py",
        "return math.inf if value > 0 else -math.inf",
        "return math.inf",
        "tests/web/genomix/test_packed.py tests/web/genomix/test_decode.py",
    ),
    _web(
        "packed-ragged-signal",
        "genomix/binary_format.py",
        "if len(shapes) > 1 or None in shapes:",
        "if None in shapes:",
        "tests/web/genomix/test_packed.py tests/web/genomix/test_decode.py",
    ),
    # --- http_server
    _web(
        "connection-of-another-address-closed",
        "server/connections.py",
        "_silent_longest([account] if full else self._accounts.values())",
        "_silent_longest(self._accounts.values())",
        "tests/web/server/test_connections.py",
    ),
    _web(
        "http-long-polls-unlimited",
        "server/connections.py",
        "        if len(polls) >= limit:\n",
        "        if False:\n",
        "tests/web/server/test_connections.py",
    ),
    _web(
        "http-authenticated-closed-first",
        "server/connections.py",
        "return self.account.idle if self._authenticated else self.account.silent",
        "return self.account.silent",
        "tests/web/server/test_connections.py",
    ),
    _web(
        "http-answers-unlimited",
        "server/connections.py",
        "        if not self._fits(data, size):\n",
        "        if False:\n",
        "tests/web/server/test_connections.py",
    ),
    _web(
        "http-burst-accepted-at-once",
        "server/listener.py",
        "ACCEPTED_AT_ONCE = 8 ",
        "ACCEPTED_AT_ONCE = BACKLOG ",
        "tests/web/server/test_connections.py",
    ),
    # --- interface
    _interface(
        "interface-nan-default", "service.py", "math.isnan(values[p.name])}", "False}", "tests/interface/test_values.py"
    ),
    _interface(
        "interface-zero-not-default",
        "service.py",
        "if not _is_unset(p, values[p.name])})",
        "})",
        "tests/interface/test_values.py",
    ),
    # --- live
    _web(
        "live-page-keeps-deadline",
        "live/server.py",
        "        connection_of(request).request_parsed()\n",
        "",
        "tests/web/live/test_failures.py -k deadline",
    ),
    _web(
        "live-any-token",
        "live/access.py",
        "if not hmac.compare_digest(token, self.token.encode()):",
        "if not token:",
        "tests/web/live/test_server.py",
    ),
    _web(
        "live-other-origin",
        "live/access.py",
        "        check_same_origin(headers)\n",
        "",
        "tests/web/live/test_server.py",
    ),
    _web(
        "live-pages-unlimited",
        "live/server.py",
        "if len(self._clients) >= MAX_CLIENTS:",
        "if False:",
        "tests/web/live/test_server.py -k limit",
    ),
    _web(
        "live-columns-too-fast",
        "live/plot_data.py",
        "math.ceil(processor.rate / MAX_COLUMN_RATE - 1e-9)",
        "math.floor(processor.rate / MAX_COLUMN_RATE)",
        "tests/web/live/test_plots.py",
    ),
    # --- localization
    _localization(
        "replaced-frames-not-subtracted",
        "evidence.py",
        "if few and len(replaced):",
        "if False:",
        "tests/localization/test_evidence.py",
    ),
    _localization(
        "rotation-of-another-frame",
        "evidence.py",
        "np.repeat(yaw, evidence.shape[1])",
        "np.tile(yaw, evidence.shape[1])",
        "tests/localization/test_evidence.py",
    ),
    _localization(
        "source-of-no-length",
        "scene_file.py",
        "if end <= start:",
        "if end < start:",
        "tests/localization/test_scene.py",
    ),
    _localization(
        "model-learned-again-for-integer-rate",
        "model_cache.py",
        "    sample_rate = float(sample_rate)  # 44100 and 44100.0 have the same model\n",
        "",
        "tests/localization/test_localize.py -k models_are_cached",
    ),
    _localization(
        "model-of-another-user-used",
        "model_cache.py",
        "path.is_symlink() or foreign(path)",
        "False",
        "tests/localization/test_files.py -k other_users",
    ),
    _localization(
        "model-of-another-head-used",
        "model_cache.py",
        "(model.head, model.sample_rate, model.parameters) == (head.key, sample_rate, values)",
        "(model.sample_rate, model.parameters) == (sample_rate, values)",
        "tests/localization/test_files.py -k damaged_entry",
    ),
    _localization(
        "model-learned-again-for-a-copy-of-a-head",
        "model_cache.py",
        "            _by_key.get(key)\n",
        "            None\n",
        "tests/processing/test_copies.py -k share_its_models",
    ),
    _localization(
        "tracker-never-forgets",
        "tracker.py",
        "if excess > 0 else -_LOSS",
        "if excess > 0 else 0.0",
        "tests/localization/test_tracker.py",
    ),
    _localization(
        "tracker-gate-open",
        "tracker.py",
        "if distance[row, column] <= GATE\n",
        "\n",
        "tests/localization/test_tracker.py",
    ),
    _localization(
        "azimuth-difference-not-wrapped",
        "angles.py",
        "return wrap(first - second)",
        "return first - second",
        "tests/localization/test_tracker.py tests/localization/test_head.py",
    ),
    _localization(
        "head-ild-swapped-ears",
        "head.py",
        "10 * np.log10(energies[1] / energies[0])",
        "10 * np.log10(energies[0] / energies[1])",
        "tests/localization/test_head.py",
    ),
    # --- node
    _ros1(
        "node-half-restored-tree-stays",
        "afe/saved_tree.py",
        "            if self._pending is setup:\n                self._tree.stop()\n",
        "",
        "tests/ros1/afe/test_saved_tree.py",
    ),
    _ros1(
        "node-slow-call-blocks-others",
        "afe/processor_health.py",
        "                self._tree.skip(processor, block)\n",
        "",
        "tests/plugins/test_node.py tests/ros1/afe/test_lag.py",
    ),
    # --- offline
    _processing(
        "offline-last-frame-lost",
        "chain.py",
        "-((start - self._frames) // hop)",
        "(self._frames - start) // hop",
        "tests/results/test_results.py -k padd",
    ),
    _results(
        "offline-mat-length",
        "mat5.py",
        "if data.end > source.end or data.end - data.start != count * dtype.itemsize:",
        "if data.end > source.end:",
        "tests/results/test_damaged.py -k mat5",
    ),
    _results(
        "offline-lags-not-aligned",
        "collector.py",
        "first = (shape[middle] - block.shape[middle]) // 2",
        "first = 0",
        "tests/results/test_collector.py tests/processing/test_changes.py",
    ),
    _processing(
        "offline-error-ignored",
        "chain.py",
        "            raise self._listener.error\n",
        "            return\n",
        "tests/processing/test_process.py tests/processing/test_stream.py",
    ),
    # --- representations
    _representations(
        "ild-swapped-ears",
        "ild.py",
        "energies[1] / energies[0]",
        "energies[0] / energies[1]",
        "tests/dsp/test_kernels.py -k 'test_ild and not aarch64'",
    ),
    _representations(
        "ratemap-integrator-not-reset",
        "ratemap.py",
        "        self._integrator.reset()\n",
        "",
        "tests/dsp/test_changes.py tests/dsp/test_blocks.py -k ratemap",
    ),
    _representations(
        "pitch-plateau",
        "pitch.py",
        "return (begin + 1 + end) // 2, np.maximum(height, 0.0)",
        "return begin + 1, np.maximum(height, 0.0)",
        "tests/representations/test_pitch.py",
    ),
    _representations(
        "pitch-median-edge",
        "pitch.py",
        'return (self.values["pi_medianOrder"] - 1) // 2',
        'return self.values["pi_medianOrder"] // 2',
        "tests/representations/test_pitch.py",
    ),
    _representations(
        "correlation-lag-sign",
        "crosscorrelation.py",
        "scipy.fft.rfft(left, transform), np.conj(scipy.fft.rfft(right, transform))",
        "np.conj(scipy.fft.rfft(left, transform)), scipy.fft.rfft(right, transform)",
        "tests/dsp/test_kernels.py -k 'test_cross_correlation and not aarch64'",
    ),
    # --- setups
    _setups(
        "setup-extra-not-checked",
        "plan.py",
        "if stage.required_extra and stage.required_extra not in extras[processor.parent]:",
        "if False:",
        "tests/setups/test_loading.py",
    ),
    _setups(
        "setup-other-parent",
        "plan.py",
        "    if existing.parent != parent:\n",
        "    if False:\n",
        "tests/setups/test_loading.py",
    ),
    _setups(
        "setup-parameter-twice",
        "reading.py",
        "        if parameter.name in values:\n",
        "        if False:\n",
        "tests/setups/test_files.py",
    ),
    # --- files and nodes
    Mutation(
        "output-not-locked",
        "rosafe/system/output.py",
        "            lock_file(descriptor)\n",
        "",
        "tests/commands/test_writers.py -k second_writer",
    ),
    _ros1(
        "nohup-not-respected",
        "component/startup.py",
        "    nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN\n",
        "    nohup = False\n",
        "tests/ros1/startup/test_startup.py -k nohup",
    ),
    # --- sound
    _audio(
        "device-plugins-unlimited",
        "devices/pcmname.py",
        "if plugin not in _PLUGINS:",
        "if False:",
        "tests/audio/test_dangerous_names.py tests/audio/test_pcmname.py",
    ),
    _audio(
        "bag-next-stream",
        "devices/bag.py",
        "islice(streams, self._stream - 1, None)",
        "islice(streams, self._stream, None)",
        "tests/audio/test_bag.py",
    ),
    _audio(
        "sound-jump-without-limit",
        "files/windows.py",
        "MAX_JUMP_SECONDS = 3600.0",
        "MAX_JUMP_SECONDS = 1e9",
        "tests/audio/test_windows.py",
    ),
    _audio(
        "sound-infinity-swapped",
        "files/audiofile.py",
        "posinf=1.0, neginf=-1.0",
        "posinf=-1.0, neginf=1.0",
        "tests/audio/test_file_source.py tests/commands/test_streams.py",
    ),
    _audio(
        "sound-truncated-file",
        "files/containers.py",
        "    if stated > available:\n",
        "    if False:\n",
        "tests/audio/test_sound_formats.py tests/audio/test_file_source.py",
    ),
    # --- transport
    _ros1(
        "request-size-unlimited",
        "transport/server_limits.py",
        "        if size > self._limit:\n",
        "        if False:\n",
        "tests/ros1/afe/test_attacks.py",
    ),
    _ros1(
        "header-size-off-by-one",
        "transport/server_limits.py",
        "if size > HEADER_BYTES:",
        "if size >= HEADER_BYTES:",
        "tests/ros1/afe/test_attacks.py tests/ros1/afe/test_handshake_server.py",
    ),
    _ros1(
        "newest-connection-closed",
        "transport/handshake_server.py",
        "pending = next(iter(self._pending.values()), None)",
        "pending = next(reversed(self._pending.values()), None)",
        "tests/ros1/afe/test_handshake_server.py",
    ),
    _ros1(
        "listener-stays-paused",
        "transport/handshake_server.py",
        "                self._paused_until = 0.0\n                self._selector.register",
        "                self._selector.register",
        "tests/ros1/afe/test_handshake_server.py",
    ),
    _ros1(
        "late-request-ends-the-owner",
        "transport/succession.py",
        "replaced or owner == address or (owner is None and not self.up)",
        "replaced or (not self.up and owner in (address, None))",
        "tests/ros1/startup/test_succession.py -k ignored",
    ),
    _ros1(
        "registers-after-the-name-was-lost",
        "transport/succession.py",
        "            if self.succession.over:\n",
        "            if False:\n",
        "tests/ros1/startup/test_succession.py -k registers_nothing",
    ),
    _ros1(
        "closed-topic-keeps-message",
        "transport/publisher.py",
        "        super().close()\n        self.latch = None\n",
        "        super().close()\n",
        "tests/ros1/afe/test_memory.py",
    ),
    # --- tree
    _tree(
        "removed-input-in-a-cycle",
        "processor.py",
        "reader, self._source_reader = self._source_reader, None",
        "reader = self._source_reader",
        "tests/tree/test_concurrency.py -k freed",
    ),
    _tree(
        "estimate-contains-waiting",
        "processor.py",
        "needed = used if self.trusted else seconds",
        "needed = seconds",
        "tests/tree/test_workers.py -k estimated",
    ),
    _tree(
        "released-while-read",
        "states.py",
        "            if self._readers:\n",
        "            if False:\n",
        "tests/tree/test_states.py -m 'not long'",
    ),
    _tree(
        "skipped-flag-stays",
        "states.py",
        "            del self.skipped\n",
        "            pass\n",
        "tests/plugins/test_failures.py -k not_return",
    ),
    _tree(
        "plugin-on-receiving-thread",
        "workers.py",
        "if not task.trusted or task",
        "if task",
        "tests/tree/test_workers.py -k calling_thread",
    ),
    _tree(
        "port-window-not-renewed",
        "history.py",
        "                self._port_window = (-1.0, ())\n",
        "",
        "tests/tree/test_window.py -k port_window",
    ),
    _tree(
        "slot-returned-twice",
        "workers.py",
        "me.task, me.has_slot = None, False",
        "me.task = None",
        "tests/tree/test_workers.py",
    ),
    _tree(
        "blocked-worker-keeps-slot",
        "workers.py",
        "                        self._free_slots += 1\n",
        "                        pass\n",
        "tests/tree/test_workers.py",
    ),
    _tree(
        "window-one-frame-late",
        "sliding_window.py",
        "max(0, self._held - length), 0",
        "max(0, self._held - length - 1), 0",
        "tests/tree/test_window.py",
    ),
    _tree(
        "change-not-previewed",
        "tree.py",
        "        self._check_memory(previews, replaced=processor)\n",
        "",
        "tests/tree/test_sizes.py tests/tree/test_requests.py",
    ),
    # --- validation and citations
    _representations(
        "ihc-order-of-dau1996",
        "haircell.py",
        '"dau1996": (1, 1000.0, 1)',
        '"dau1996": (2, 1000.0, 1)',
        "tests/dsp/test_truths.py",
    ),
    _declarations(
        "citation-applies-if-any-condition-does",
        "reference.py",
        "return all(_matches",
        "return any(_matches",
        "tests/interface/test_references.py",
    ),
    _interface(
        "citing-ignores-parameters",
        "citing.py",
        "for c in applicable(kind.references, parameters)}",
        "for c in applicable(kind.references, {})}",
        "tests/commands/test_cite.py",
    ),
    _validation(
        "validation-tolerance-ignored",
        "report.py",
        "return self.deviation <= self.comparison.tolerance",
        "return self.deviation >= 0",
        "tests/validation/test_validate.py",
    ),
    _validation(
        "validation-self-test-without-disturbance",
        "report.py",
        "if disturbed and comparison.disturbance:",
        "if False:",
        "tests/validation/test_validate.py",
    ),
    # --- localizer node
    _ros1(
        "messages-of-an-earlier-stream",
        "localizer/frame_source.py",
        "if index < self._newest:",
        "if False:",
        "tests/ros1/localizer/test_frame_source.py",
    ),
    _ros1(
        "successor-loses-its-processors",
        "localizer/tree_link.py",
        "if self._created.names and not registration.registrar().is_replaced:",
        "if self._created.names:",
        "tests/ros1/localizer/test_tree_link.py",
    ),
    _ros1(
        "localizer-sources-stay",
        "localizer/localization_loop.py",
        "if self._newest and (self._queue.muted or now - self._used_at > limit):",
        "if False:",
        "tests/ros1/localizer/test_node.py -k end_of_the_sound",
    ),
    _ros1(
        "localizer-processors-left-behind",
        "localizer/tree_link.py",
        "            try:\n                await self._created.remove(graph, client)\n",
        "            try:\n                pass\n",
        "tests/ros1/localizer/test_recovery.py -k own_processors",
    ),
    _ros1(
        "localizer-muted-frames-used",
        "localizer/frame_queue.py",
        "kept = known & ~self._mute.muted(joined.middles[:ready])",
        "kept = known",
        "tests/ros1/localizer/test_frame_queue.py",
    ),
    # --- view
    _view(
        "plot-wrong-ear",
        "plot.py",
        "_Panel(result, names[0], **options).draw(ax, EARS.index(ear or EARS[0]))",
        "_Panel(result, names[0], **options).draw(ax, 0)",
        "tests/view/test_plot.py",
    ),
    _view(
        "plot-of-several-outputs",
        "plot.py",
        "    if len(names) != 1:\n",
        "    if not names:\n",
        "tests/view/test_plot.py",
    ),
    # --- Tcl and MATLAB
    Mutation(
        "tcl-second-status",
        "tcl/genomix/request.tcl",
        'if {$Status ne "sent" || [dict get $new status] eq "sent"} {',
        'if {[dict get $new status] eq "sent"} {',
        "tests/web/genomix/test_tcl.py",
    ),
    Mutation(
        "tcl-error-reported-though-read",
        "tcl/genomix/request.tcl",
        "        if {$Seen} {\n            return\n        }\n",
        "",
        "tests/web/genomix/test_tcl.py",
    ),
    # --- packages
    Mutation(
        "catkin-tcl-not-installed",
        "CMakeLists.txt",
        "install(DIRECTORY tcl/ DESTINATION ${CATKIN_GLOBAL_LIB_DESTINATION}/tcltk)\n",
        "",
        "tests/packaging/test_catkin.py -m 'not exploration'",
    ),
    Mutation(
        "debian-dependency-missing",
        "debian/control",
        " python3-rosbag,\n",
        "",
        "tests/packaging/test_debian_folder.py",
    ),
    Mutation(
        "debian-messages-link-into-the-checkout",
        "debian/messages.py",
        "            link.unlink()\n",
        "            pass\n",
        "tests/packaging/test_debian_folder.py",
    ),
    _dsp(
        "kernels-truncated-library-loaded",
        "kernels/build.py",
        " or sums.get(p.name) != _sum(p)]",
        "]",
        "tests/packaging/test_kernels.py",
    ),
    Mutation(
        "kernels-writable-by-others",
        "rosafe/system/trust.py",
        "found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX",
        "False",
        "tests/packaging/test_kernels.py",
    ),
)


def _copy(folder: Path) -> Path:
    """Copy the tracked files and the generated ones; `../shared` is a link."""
    copy = folder / "tree"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).exists():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
    if (ROOT / ".generated").is_dir():
        shutil.copytree(ROOT / ".generated", copy / ".generated", symlinks=True)
    if (ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to(ROOT.parent / "shared")
    # Python compares the content of a source with its compiled file, so that it compiles only modified ones again.
    compiled = [PYTHON, "-m", "compileall", "-q", "--invalidation-mode", "checked-hash", "rosafe", "tests"]
    subprocess.run(compiled, cwd=copy, check=True)
    return copy


def detected_by(mutation: Mutation, copy: Path) -> str:
    """Return the first line with a failed test, or an empty string if the mutation survives."""
    path = copy / mutation.path
    original = path.read_text("utf-8")
    if original.count(mutation.old) != 1:
        raise ValueError(f"{mutation.name}: expected its old text once in {mutation.path}")
    path.write_text(original.replace(mutation.old, mutation.new), "utf-8")
    try:
        return first_failure(mutation.tests, copy)
    finally:
        path.write_text(original, "utf-8")


def first_failure(tests: str, copy: Path) -> str:
    """Run tests; return the first line with a failed one, or an empty string."""
    command = f"exec timeout -k 5 {TIMEOUT_SECONDS} {PYTHON} -m pytest -n0 -x -q -p no:cacheprovider {tests}"
    done = subprocess.run(
        ["sh", "-c", command],
        cwd=copy,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},  # compiled files are found by size and second
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode == TIMED_OUT:
        return f"no end within {TIMEOUT_SECONDS} s"
    if done.returncode not in (0, PYTEST_FAILED):  # no test has run: the mutation, or the tests named, are wrong
        raise ValueError(f"{tests}: pytest returned {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED tests", "ERROR tests"))]
    return failed[0].split(" - ")[0].partition(" ")[2] if failed else ""


def judge(mutation: Mutation, copies: queue.SimpleQueue[Path], unmodified: dict[str, str]) -> tuple[bool, str]:
    """Return whether tests detect a mutation, and its row of the table.

    `copies` has the copies that are not in use. `unmodified` has the first failure of tests without a mutation.
    """
    begin = time.monotonic()
    copy = copies.get()
    try:
        result = detected_by(mutation, copy)
        if result and mutation.tests not in unmodified:
            unmodified[mutation.tests] = first_failure(mutation.tests, copy)
        other = result and unmodified[mutation.tests]
        detected = bool(result) and not other
        if other:
            result = f"**{other} fails without the mutation, too**"
    except ValueError as problem:
        detected, result = False, "**no test has run**"
        print(problem, file=sys.stderr)
    finally:
        copies.put(copy)
    seconds = time.monotonic() - begin
    return detected, f"| {mutation.name} | {mutation.path} | {result or '**survives**'} | {seconds:.0f} |"


def main(arguments: list[str]) -> int:
    """Apply the named mutations, or all; print a table; return 1 if one survives."""
    parser = argparse.ArgumentParser(prog="scripts/test --mutations", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="names or their beginnings; all by default")
    parser.add_argument(
        "-j", "--jobs", type=int, default=os.cpu_count(), help="mutations at the same time (default: cores)"
    )
    options = parser.parse_args(arguments)
    chosen = [m for m in MUTATIONS if not options.names or m.name.startswith(tuple(options.names))]
    if not chosen or options.jobs < 1:
        parser.error(f"expected a beginning of one of {', '.join(m.name for m in MUTATIONS)}, and at least one job")
    detected = 0
    unmodified: dict[str, str] = {}
    copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
    print("| mutation | file | result | s |\n|---|---|---|---|", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="rosafe-mutations.") as folder,
        concurrent.futures.ThreadPoolExecutor(options.jobs) as pool,
    ):
        for number in range(options.jobs):
            copies.put(_copy(Path(folder, str(number))))
        for passed, row in pool.map(lambda mutation: judge(mutation, copies, unmodified), chosen):
            detected += passed
            print(row, flush=True)
    print(f"\n{detected} of {len(chosen)} mutations are detected")
    return 0 if detected == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
