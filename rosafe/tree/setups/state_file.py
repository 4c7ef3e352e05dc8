"""The setup of a running node in a file, which is complete at any time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from rosafe.interface import MAX_SETUP, ROSAFE
from rosafe.system.input import read_regular
from rosafe.system.output import OutputError, write_whole
from rosafe.system.terminal import printable
from rosafe.tree.tree_planner import searched

from .markup import SetupError
from .reading import read
from .setup import Setup
from .writing import write


class TreeStateFile:
    """A setup file (docs/setups.md) that is complete at any time, even if the process is killed or the power fails.

    Parameters
    ----------
    path : Path
    describe : callable
        Returns the setup to save.
    report : callable
        Called with one line for the log if the file cannot be written; again only after a success.

    Attributes
    ----------
    problem : str
        Why the file could not be written the last time.
    absent : str
        Which of the saved processors cannot be built because plugins are missing.
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
        """Return the setup in the file; an empty one if the file does not exist. Raises ComponentError."""
        try:
            self._written = read_regular(self.path, 4 * MAX_SETUP + 1).decode()
            absent: list[str] = []
            setup = read(self._written, absent)
            if absent:
                copy = self.path.with_name(f"{self.path.name}.complete")
                write_whole(copy, self._written.encode())
                self.absent = f"left out of the tree: {', '.join(absent)}; {searched()}; {copy} contains all of it"
            return setup
        except FileNotFoundError:
            return Setup()
        except (OSError, OutputError, UnicodeDecodeError, SetupError) as problem:
            why = getattr(problem, "strerror", None) or problem
            what = f"{self.path}: {why}; correct the file, or delete it to start with an empty tree"
            raise ROSAFE.error("e_badNewValue", what=printable(what)) from None

    def save(self) -> None:
        """Write all changes made so far to the file, if there are any. A failure is only reported."""
        with self._lock:  # after waiting here, the change has usually been written by the previous thread
            text = "" if self._closed else write(self._describe(), full=True)
            if text in ("", self._written):
                return
            try:
                write_whole(self.path, text.encode())
                self._written, self.problem = text, ""
            except OutputError as failure:
                problem = printable(failure)  # ROS messages cannot contain bytes that are not UTF-8
                if not self.problem:
                    self._report(f"the tree is not kept: {problem}")
                self.problem = problem

    def close(self) -> None:
        """Ignore later calls of `save`."""
        with self._lock:
            self._closed = True
