"""Memory that is asked for ahead, held against what the kernel says of the process's pages."""

from __future__ import annotations

import contextlib
import mmap
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.bags.message_batch import Bytes
from agv_analysis.bags.prefault import Prefault

MIB = 2**20


def resident(array: Bytes) -> int:
    """Bytes of the mappings in which the array lies that have pages; they hold little else."""
    first, total, is_inside = array.ctypes.data, 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if bounds := re.match("([0-9a-f]+)-([0-9a-f]+) ", line):
            is_inside = int(bounds[1], 16) < first + len(array) and first < int(bounds[2], 16)
        elif is_inside and line.startswith("Rss:"):
            total += 1024 * int(line.split()[1])
    return total


def knows_the_request() -> bool:
    """Asked by Python's own `madvise`: pages to be made as by a write, as Linux does since 5.14."""
    if sys.platform != "linux":
        return False
    with mmap.mmap(-1, mmap.PAGESIZE) as page, contextlib.suppress(OSError):
        page.madvise(23)
        return True
    return False


@pytest.mark.skipif(not knows_the_request(), reason="this kernel cannot be asked for pages ahead: Linux 5.14 can")
def test_pages_are_there_before_they_are_written_to() -> None:
    array = np.zeros(256 * MIB, np.uint8)
    before = resident(array)
    with ThreadPoolExecutor(1) as helper:
        Prefault(array, helper).reach(32 * MIB)
    found = (resident(array) - before) / MIB
    assert 40 <= found <= 72  # not much more than asked for: others need memory, too


def test_what_is_written_meanwhile_stays_and_the_rest_is_zero() -> None:
    array = np.zeros(64 * MIB + 5, np.uint8)
    with ThreadPoolExecutor(1) as helper:
        pages = Prefault(array, helper)
        for begin in range(0, len(array), MIB):
            pages.reach(begin + MIB)
            array[begin : begin + MIB : 1000] = 7
    expected = np.zeros_like(array)
    for begin in range(0, len(array), MIB):
        expected[begin : begin + MIB : 1000] = 7
    np.testing.assert_array_equal(array, expected)


def test_an_array_of_less_than_a_page_and_an_empty_one_need_nothing() -> None:
    with ThreadPoolExecutor(1) as helper:
        for size in (0, 1, 4095):
            array = np.zeros(size, np.uint8)
            Prefault(array, helper).reach(size)
            assert not array.any()
