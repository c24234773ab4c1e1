"""A folder in which one process at a time does its work."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def one_process_at_a_time(folder: Path) -> Iterator[None]:
    """Hold a lock on a folder, which the system takes from a process that ends, however it does.

    Where there are no such locks, as on Windows and some network file systems, nothing is held.
    """
    try:
        import fcntl

        file = (folder / "lock").open("w")
    except (ImportError, OSError):
        yield
        return
    with file:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
