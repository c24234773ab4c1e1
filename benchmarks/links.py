"""Measured links: text formats against a regular expression over the same lines and against pyarrow's CSV reader.

Ours names what is no record, finds packets that are missing and dates all of them, which the peers do not.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from agv_analysis.link.formats import read_link
from agv_analysis.link.formats.format import Options
from benchmarks.comparison import Comparison

RECORDS = 500_000
_PING = re.compile(rb"^\[([\d.]+)\] \d+ bytes from [^:]*: icmp_seq=(\d+) ttl=\d+ time=([\d.]+) ms", re.MULTILINE)


def measure() -> list[Comparison]:
    """Records a second of a ping log and of a table."""
    import pyarrow.csv

    with tempfile.TemporaryDirectory() as folder:
        log, table = Path(folder) / "ping.txt", Path(folder) / "table.csv"
        kept = [i for i in range(RECORDS) if i % 97]
        log.write_text(
            "".join(
                f"[{1.7e9 + 0.02 * i:.6f}] 64 bytes from 10.0.0.2: icmp_seq={i % 65536} ttl=64 time={1 + i % 7}.25 ms\n"
                for i in kept
            )
        )
        table.write_text(
            "time,lost,delay\n" + "".join(f"{0.02 * i:.3f},{int(i % 97 == 0)},0.0125\n" for i in range(RECORDS))
        )
        ours = [_rate(lambda path=path: read_link(path, Options())) for path in (log, table)]  # type: ignore[misc]
        peers = [
            _rate(lambda: [tuple(map(float, found)) for found in _PING.findall(log.read_bytes())]),
            _rate(lambda: pyarrow.csv.read_csv(table)),
        ]
    rows = (
        ("log of ping", "re.findall, as floats", 2.0),
        ("table of three columns", "pyarrow.csv, columns alone", None),
    )
    return [
        Comparison(what, one, name, peer, "records/s", aim)
        for (what, name, aim), one, peer in zip(rows, ours, peers, strict=True)
    ]


def _rate(work: Callable[[], object]) -> float:
    """Records a second of the best of three."""
    best = float("inf")
    for _ in range(3):
        begin = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begin)
    return RECORDS / best
