"""Measured links: text formats against a regular expression over the same lines, pyarrow's CSV reader, the JSON module.

Ours names what is not a record, finds packets that are missing and dates all of them, which the peers do not.
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from agv_analysis.link.formats import read_link
from agv_analysis.link.formats.format import Options
from benchmarks.comparison import Comparison

RECORDS, TRIPS = 500_000, 50_000
_PING = re.compile(rb"^\[([\d.]+)\] \d+ bytes from [^:]*: icmp_seq=(\d+) ttl=\d+ time=([\d.]+) ms", re.MULTILINE)


def measure() -> list[Comparison]:
    """Records a second of a ping log, of irtt's raw lines, of a table, and of irtt's JSON."""
    import pyarrow.csv

    with tempfile.TemporaryDirectory() as folder:
        log, raw, table, trips = (Path(folder) / name for name in ("ping.txt", "raw.txt", "table.csv", "irtt.json"))
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
        raw.write_text("".join(f"{i} {5 + i % 7 / 10:f} 2.500000 2.500000 0.010000 0 0\n" for i in kept))
        trips.write_text(json.dumps({"round_trips": [_trip(i) for i in range(TRIPS)]}, indent=4))
        ours = [_rate(lambda path=path: read_link(path, Options())) for path in (log, raw, table)]  # type: ignore[misc]
        ours.append(_rate(lambda: read_link(trips, Options()), TRIPS))
        peers = [
            _rate(lambda: [tuple(map(float, found)) for found in _PING.findall(log.read_bytes())]),
            _rate(lambda: [tuple(map(float, line.split())) for line in raw.read_bytes().splitlines()]),
            _rate(lambda: pyarrow.csv.read_csv(table)),
            _rate(lambda: json.loads(trips.read_bytes()), TRIPS),
        ]
    rows = (
        ("log of ping", "re.findall, as floats", 2.0),
        ("irtt -r", "line.split, as floats", 1.5),
        ("table of three columns", "pyarrow.csv, columns alone", None),
        ("irtt's JSON", "json.loads alone, as dicts", 5.0),
    )
    return [
        Comparison(what, one, name, peer, "records/s", aim)
        for (what, name, aim), one, peer in zip(rows, ours, peers, strict=True)
    ]


def _trip(i: int) -> dict[str, object]:
    """A round trip as irtt writes it."""
    stamp = {"wall": 1_700_000_000_000_000_000 + 20_000_000 * i, "monotonic": 20_000_000 * i}
    both = {"receive": stamp, "send": stamp}
    delay = {"receive": 2_500_000, "rtt": 5_012_345, "send": 2_512_345}
    return {"seqno": i, "lost": "false", "timestamps": {"client": both, "server": both}, "delay": delay, "ipdv": delay}


def _rate(work: Callable[[], object], records: int = RECORDS) -> float:
    """Records a second of the best of three."""
    best = float("inf")
    for _ in range(3):
        begin = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begin)
    return records / best
