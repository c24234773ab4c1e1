"""Processes that begin with everything imported: the start of Python and its imports are most of what a node costs.

They are forked from a process that has imported the nodes and has neither a thread nor a DDS participant. What they do
from then on is what the program does: arguments, signals, exit status, output. The interpreter's own end is left out;
nodes that a runner starts are programs from their beginning to their end.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from agv_analysis.runtime.executables import NODE_MODULES

_PR_SET_PDEATHSIG = 1
"""Of prctl(2)."""


def import_all() -> None:
    """Import what the processes need, before the first of them is made."""
    for module in (*NODE_MODULES.values(), "agv_analysis.cli", "agv_analysis.runtime.processes"):
        importlib.import_module(module)


class Forked:
    """A process that runs `main`, with its output in the file `log`; used as a subprocess.Popen is."""

    def __init__(self, main: Callable[[], object], log: Path) -> None:
        self.log = log
        self.returncode: int | None = None
        log.touch()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # what is in their buffers would be written twice
        self.pid = os.fork()
        if self.pid == 0:
            _run(main, log)

    def said(self) -> str:
        """What it has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def poll(self) -> int | None:
        """Exit status, None while it runs; negative if a signal ended it."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it by force and wait for it."""
        self.send_signal(signal.SIGKILL)
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def end_with_parent() -> None:
    """Have Linux kill this process when the one that forked it ends, however that ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))


def _run(main: Callable[[], object], log: Path) -> None:
    """Body of the new process, which never returns."""
    status = 1
    try:
        end_with_parent()
        _connect(log)
        for number in (signal.SIGHUP, signal.SIGTERM):  # `nohup` has them ignored, which a process inherits
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        main()
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        if isinstance(ended.code, str):
            sys.stderr.write(f"{ended.code}\n")
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(status)  # what is to be done at exit, such as to remove directories, is the first process' to do


def _connect(log: Path) -> None:
    """Standard input is empty, output goes to the file, line by line."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    # Whatever these names stood for before, as in a test whose output is captured.
    sys.stdout, sys.stderr = (open(number, "w", buffering=1, encoding="utf-8", closefd=False) for number in (1, 2))  # noqa: SIM115
