"""Segments of shared memory that processes of DDS left behind when they were killed: later runs can hang on them.

A process that uses a segment has it mapped or open, or holds the lock on the file beside it; Fast DDS asks the same
lock. One that is neither belongs to no process that lives, though it may have been made by one in a container, which is
not seen in /proc but whose lock is.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

SHARED_MEMORY = Path("/dev/shm")

_OF_DDS = re.compile(r"(sem\.)?(fastrtps|fastdds)_.+|iceoryx.+|iox_.+")
_LOCKS = ("_el", "_sl")
"""Endings of the files that Fast DDS locks, alone or shared, as long as it uses a segment."""

SETTLED = 5.0
"""A file younger than this [s] may belong to a process that is about to use it."""


class Leftover(NamedTuple):
    """A file that no process uses."""

    path: Path
    size: int
    """[bytes]"""
    mine: bool
    """Is it of this user?"""

    def to_json(self) -> dict[str, Any]:
        """As the JSON file has it."""
        return {"path": str(self.path), "size": self.size, "mine": self.mine}


def held_by(process: int, folder: Path = SHARED_MEMORY) -> list[Path]:
    """Files of DDS in `folder` that a process has mapped or open, as far as this user may see them."""
    return sorted(
        {folder / name for name in _used_by(Path(f"/proc/{process}"), str(folder)) if _OF_DDS.fullmatch(name)}
    )


def leftovers(folder: Path = SHARED_MEMORY, settled: float = SETTLED) -> list[Leftover]:
    """Files of DDS in `folder` that no process uses and that are at least `settled` [s] old, by name."""
    files = [path for path in sorted(folder.glob("*")) if _OF_DDS.fullmatch(path.name) and not path.is_symlink()]
    used = set(_in_use(str(folder))) if files else set()
    return [found for path in files if path.name not in used if (found := _leftover(path, settled))]


def remove(found: list[Leftover], settled: float = SETTLED) -> list[Leftover]:
    """Remove those of this user that still are not used; gives those that were removed."""
    removed = []
    still = {one.path for folder in {one.path.parent for one in found} for one in leftovers(folder, settled)}
    for one in found:
        if one.mine and one.path in still:
            one.path.unlink(missing_ok=True)
            removed.append(one)
    return removed


def _leftover(path: Path, settled: float) -> Leftover | None:
    try:
        about = path.stat()
    except FileNotFoundError:
        return None
    is_young = time.time() - about.st_ctime < settled
    if is_young or any(_is_locked(Path(f"{_segment(path)}{ending}")) for ending in ("", *_LOCKS)):
        return None
    return Leftover(path, about.st_size, about.st_uid == os.getuid())


def _segment(path: Path) -> str:
    """The file whose lock says that `path` is used: a lock's own segment, a mutex's port."""
    name = re.sub(r"^sem\.|_mutex$|_el$|_sl$", "", path.name)
    return str(path.with_name(re.sub(r"_mutex$", "", name)))


def _is_locked(path: Path) -> bool:
    """Does a process hold a lock on the file? One that cannot be opened counts as held."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def _in_use(folder: str) -> Iterator[str]:
    """Names of the files in `folder` that processes have mapped or open, as far as this user may see them."""
    for process in Path("/proc").glob("[0-9]*"):
        yield from _used_by(process, folder)


def _used_by(process: Path, folder: str) -> Iterator[str]:
    """The same of one process; none of one that has ended, or is another user's."""
    with suppress(OSError):
        yield from re.findall(rf" {re.escape(folder)}/(.+)$", (process / "maps").read_text(), re.MULTILINE)
        files = [descriptor.readlink() for descriptor in (process / "fd").iterdir()]
        yield from (file.name for file in files if str(file.parent) == folder)
