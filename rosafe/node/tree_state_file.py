"""A node's tree in a file, so that a node that was killed comes back as it was: `rosAFE-ros --keep FILE`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from rosafe.input import read_regular
from rosafe.interface import MAX_SETUP, ROSAFE
from rosafe.output import OutputError, write_whole
from rosafe.setups import Setup, SetupError, read, write
from rosafe.terminal import printable
from rosafe.tree.tree_planner import searched


class TreeStateFile:
    """Writes what `describe` tells into a file, whenever `save` is called and it has changed.

    The file is a setup (docs/setups.md): whole at any moment, whatever kills the process or the machine.

    Parameters
    ----------
    path : Path
    describe : callable
        The setup that is in force.
    report : callable
        Gets one line for the log where the file cannot be written, once until it can.

    Attributes
    ----------
    problem : str
        Why it could not be written the last time.
    absent : str
        Which of its processors cannot be built, because plugins are missing.
    """

    def __init__(self, path: Path, describe: Callable[[], Setup], report: Callable[[str], None]) -> None:
        self.path = path
        self.problem = ""
        self.absent = ""
        self._describe = describe
        self._report = report
        self._written = ""
        self._closed = False
        self._lock = threading.Lock()

    def saved(self) -> Setup:
        """What the file holds; an empty setup where there is none yet. ComponentError where it cannot be used."""
        try:
            self._written = read_regular(self.path, 4 * MAX_SETUP + 1).decode()
            absent: list[str] = []
            setup = read(self._written, absent)
            if absent:
                copy = self.path.with_name(f"{self.path.name}.complete")
                write_whole(copy, self._written.encode())
                self.absent = f"left out of the tree: {', '.join(absent)}; {searched()}; all of it is in {copy}"
            return setup
        except FileNotFoundError:
            return Setup()
        except (OSError, OutputError, UnicodeDecodeError, SetupError) as problem:
            why = getattr(problem, "strerror", None) or problem
            what = f"{self.path}: {why}; correct the file, or delete it to start with an empty tree"
            raise ROSAFE.error("e_badNewValue", what=printable(what)) from None

    def save(self) -> None:
        """Have all changes up to now in the file once this returns; where that fails, life goes on."""
        with self._lock:  # who has waited here finds, as a rule, that the one before has written his change, too
            text = "" if self._closed else write(self._describe(), full=True)
            if text in ("", self._written):
                return
            try:
                write_whole(self.path, text.encode())
                self._written, self.problem = text, ""
            except OutputError as failure:
                why = printable(failure)  # messages of ROS have no room for bytes that are not UTF-8
                if not self.problem:
                    self._report(f"the tree is not kept: {why}")
                self.problem = why

    def close(self) -> None:
        """Write nothing any more: the processors end now, and are to come back."""
        with self._lock:
            self._closed = True
