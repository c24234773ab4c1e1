"""Memory that is ready in time: its pages are requested on another thread, before they are written to.

The kernel gives memory page by page at the first write, and clears each; of a large bag that takes as long as all the
copying into it, and the writer waits. Where the kernel does not know the request (Linux before 5.14), that stays so.
"""

from __future__ import annotations

import ctypes
import mmap
import sys
from concurrent.futures import Executor

from agv_analysis.bags.message_batch import Bytes

_WINDOW = 2**24
"""Bytes that are requested at a time."""

_MADV_POPULATE_WRITE = 23
"""In <linux/mman.h>: makes pages as a write would, and leaves alone what is in those that are there."""


class Prefault:
    """Makes the pages of an array that is written from its beginning to its end, ahead of the writing."""

    def __init__(self, array: Bytes, helper: Executor | None) -> None:
        """`helper` is the thread that waits for the kernel; without one nothing is requested ahead."""
        self._array = array
        self._helper = helper if sys.platform == "linux" else None
        self._asked = 0

    def reach(self, end: int) -> None:
        """Writing continues up to byte `end`: request what follows, if that has not been done."""
        while self._helper is not None and self._asked < min(end + _WINDOW, len(self._array)):
            self._helper.submit(_populate, self._array, self._asked)
            self._asked += _WINDOW


def _populate(array: Bytes, begin: int) -> None:
    """Request the whole pages of a window; a refusal does no harm."""
    page, address = mmap.PAGESIZE, array.ctypes.data
    first = -(-(address + begin) // page) * page
    end = (address + min(begin + _WINDOW, len(array))) // page * page
    if first < end:  # by ctypes, which lets go of Python's lock; mmap's own `madvise` does not
        request = ctypes.CDLL(None).madvise
        request.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
        request(first, end - first, _MADV_POPULATE_WRITE)
