"""How a process is asked to end: by a signal, or by the end of the one that started it. Needs no ROS."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

STOPPED_BY = "stopped by "
"""Begins the line that a node logs when it is asked to end before it has done its work."""

CLOSED = "closed"
"""Begins the line that a node logs when it has published its last message, and only waits until that has arrived."""

COUNTS = "counts of messages: "
"""Begins the line in which a node that its runner has asked to end says what it has received and published."""

ENDS_WITH_STDIN = "AGV_NCS_ENDS_WITH_STDIN"
"""Environment variable: a process in which it is set ends when its standard input does.

So who starts processes holds one end of a pipe each, which the system closes however that process ends. By END, written
to it, a process is asked to end, as by a signal, but for one thing: a signal may be lost while a process starts. By
MAY_CLOSE a node that was asked may publish its last message.
"""

END, MAY_CLOSE = b"e", b"c"

_ORPHAN_PATIENCE = 1.5
"""How long [s] a process whose starter is gone may take to end in order, and then once more to end in a hurry."""

_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class Stop:
    """Set by signals, and by the end of the process that started this one."""

    def __init__(self) -> None:
        self.requested = False
        self.insisted = False
        """Asked for again: nothing is waited for any more."""
        self.may_close = not ends_with_starter()
        """Has all been answered that is under way, as far as the one who started this process knows?"""
        self.reason = ""
        """What asked first, as in "SIGTERM"."""

    def request(self, number: int, _: object = None) -> None:
        """Signal handler."""
        self.ask(signal.Signals(number).name)

    def ask(self, reason: str) -> None:
        """End in order; if that has been asked for already, at once."""
        self.insisted = self.requested
        self.requested = True
        self.reason = self.reason or reason


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Turn signals that end a process into a flag: a loop ends between two events, not in the middle of one.

    A closed terminal sends SIGHUP, which `nohup` has a process ignore. A process that ends with its starter has done
    its work then: what it is asked while it exits does not change its status.
    """
    stop = Stop()
    heeded = [n for n in _STOP_SIGNALS if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, stop.request) for number in heeded}
    if ends_with_starter():
        threading.Thread(target=_end_with_stdin, args=(stop,), daemon=True).start()
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if ends_with_starter() else handler)


def ends_with_starter() -> bool:
    """Does this process end with the one that started it?"""
    return bool(os.environ.get(ENDS_WITH_STDIN))


def _end_with_stdin(stop: Stop) -> None:
    """Body of a thread: once standard input ends, end this process, by force if need be."""
    while words := os.read(0, 4096):
        stop.may_close = stop.may_close or MAY_CLOSE in words
        if END in words and not stop.requested:
            stop.ask("the one who started it")
    for _ in range(2):
        stop.ask("the end of the process that started it")
        time.sleep(_ORPHAN_PATIENCE)
    os._exit(1)
