"""Processor, kernel and clocks of this machine."""

from __future__ import annotations

import ctypes
import os
import platform
import time
from collections import Counter
from pathlib import Path
from typing import Any

_UNSYNCHRONISED, _NANOSECONDS = 0x0040, 0x2000  # STA_UNSYNC, STA_NANO of <sys/timex.h>


class _Timex(ctypes.Structure):
    """The beginning of Linux' struct timex, and room for its rest."""

    _fields_ = [  # ctypes wants a list
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    ]


def clocks() -> dict[str, Any]:
    """Resolution [s] of the clocks, and what the kernel knows of the offset [s] of its time of day from a time server.

    `synchronised` is None where the kernel does not say; the offset is what is left to correct, not the true one, which
    is below `offset_bound`.
    """
    timex = _Timex()
    asked = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))  # modes = 0: only asks
    known = asked >= 0
    unit = 1e-9 if timex.status & _NANOSECONDS else 1e-6
    synchronised = not timex.status & _UNSYNCHRONISED if known else None
    return {
        "resolution": time.get_clock_info("time").resolution,
        "steady_resolution": time.get_clock_info("monotonic").resolution,
        "synchronised": synchronised,
        "offset": timex.offset * unit if synchronised else None,
        "offset_bound": timex.maxerror * 1e-6 if synchronised else None,
    }


def cores(cpus: Path = Path("/sys/devices/system/cpu")) -> dict[str, Any]:
    """How many cores this process may use, how busy they are, and how the kernel chooses their frequency."""
    allowed = sorted(os.sched_getaffinity(0))
    governors = Counter(
        file.read_text(encoding="ascii").strip()
        for core in allowed
        if (file := cpus / f"cpu{core}/cpufreq/scaling_governor").is_file()
    )
    return {
        "usable": len(allowed),
        "present": os.cpu_count(),
        "load": list(os.getloadavg()),
        "governors": dict(governors),
    }


def system() -> dict[str, str]:
    """Operating system, kernel and processor."""
    try:
        name = platform.freedesktop_os_release().get("PRETTY_NAME", "unknown")
    except OSError:
        name = "unknown"
    return {"system": name, "kernel": platform.release(), "processor": platform.machine()}
