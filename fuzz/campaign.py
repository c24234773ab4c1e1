"""Cases one after the other, and what comes of them."""

from __future__ import annotations

import contextlib
import json
import random
import re
import resource
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from agv_analysis.bags import Bag, BagError, read_bag
from agv_analysis.bags.bag_summary import describe
from agv_analysis.bags.recover import recover
from fuzz.bases import NAMES, OPTIONS, SQLITE3, base
from fuzz.mutations import change_bytes, change_records
from fuzz.truth import NotReadableError, payloads_by_sqlite, rows_by_mcap, rows_by_us

SLOW_S = 5.0
"""A case that takes more of the processor's time is a fault: the bags have some ten kilobytes."""

MEMORY = 2**30
"""Bytes that a process may ask for beyond what it has."""

_MOST_SAVED = 50

FAULTS = (
    "traceback", "wrong numbers in silence", "messages lost in silence", "messages made up in silence",
    "messages not recovered", "out of memory", "slow",
)  # fmt: skip

_RECOVERED = 10
"""One in so many bags is recovered, too."""

_SAYS_NOTHING_OF_MESSAGES = re.compile(
    "not checked, because|file without statistics|message index that does not fit|more than the recorder counted"
    "|record with bytes after|record of the (unknown|private) kind|summary that does not match|misstates its size"
    "|logged before the one|there twice|after the year 2262|of a second or more|storage without checksums"
    "|last eight bytes|footer that points"
)
"""Reports that do not excuse a message that is missing or has other values."""


class Case(NamedTuple):
    """A bag, and what was done to it."""

    base: str
    change: str
    data: bytes


def case(seed: int, number: int) -> Case:
    """The case with this number: one in three has random bytes changed, the others records, under right checksums."""
    draw = random.Random(f"{seed} {number}")
    name = draw.choice(NAMES)
    data = base(name)
    if name == SQLITE3 or draw.random() < 1 / 3:
        return Case(name, "bytes", change_bytes(draw, data))
    with_crcs = OPTIONS[name].get("enable_crcs", True) and name != "unchunked"
    change, found = change_records(draw, data, with_crcs)
    return Case(name, change, found)


@dataclass
class Result:
    """What came of cases."""

    cases: Counter[str] = field(default_factory=Counter)
    """By what was done."""
    compared: Counter[str] = field(default_factory=Counter)
    """Those of them that another reader could read."""
    refused: int = 0
    reported: int = 0
    """Bags that were read with something reported that the sound bag has not."""
    faults: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)
    """Of each fault the first: its case, and what was seen."""
    longest_s: float = 0.0
    seconds: float = 0.0
    peak_bytes: int = 0

    def fault(self, kind: str, number: int, what: str) -> None:
        """Count a fault."""
        self.faults[kind] += 1
        self.first.setdefault(kind, f"case {number}: {what}")

    def to_json(self) -> dict[str, Any]:
        """As a JSON object."""
        return {
            "cases": sum(self.cases.values()), "by_change": dict(self.cases), "compared": sum(self.compared.values()),
            "compared_by_change": dict(self.compared), "refused": self.refused, "reported": self.reported,
            "faults": {kind: self.faults[kind] for kind in FAULTS}, "first": self.first,
            "seconds": self.seconds, "longest_case_s": self.longest_s, "peak_memory_bytes": self.peak_bytes,
        }  # fmt: skip


def run(
    seed: int, numbers: range, folder: Path, save: Path | None, progress: Callable[[], None] = lambda: None
) -> Result:
    """Run the cases with these numbers; bags are written to `folder`, those that show a fault kept in `save`."""
    result = Result()
    usual = {name: _problems(_written(folder, Case(name, "", base(name)))) for name in NAMES}
    begun = time.perf_counter()
    with little_memory():
        for number in numbers:
            found = case(seed, number)
            path, before = _written(folder, found), sum(result.faults.values())
            _look(result, number, found, path, usual[found.base])
            if save is not None and before < sum(result.faults.values()) <= _MOST_SAVED:
                save.mkdir(parents=True, exist_ok=True)
                (save / f"{seed}_{number}{path.suffix}").write_bytes(found.data)
            progress()
    result.seconds = time.perf_counter() - begun
    result.peak_bytes = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return result


def _written(folder: Path, found: Case) -> Path:
    path = folder / ("bag.db3" if found.base == SQLITE3 else "bag.mcap")
    path.write_bytes(found.data)
    return path


def _problems(path: Path) -> frozenset[str]:
    return frozenset(read_bag(path).problems)


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """Let the process ask for little more memory than it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _look(result: Result, number: int, found: Case, path: Path, usual: frozenset[str]) -> None:
    result.cases[found.change] += 1
    begun, bag = time.process_time(), None
    try:
        bag = read_bag(path)
        json.dumps(describe(bag).to_json(), allow_nan=False)
        if number % _RECOVERED == 0 and (lost := _not_recovered(path, bag)):
            result.fault("messages not recovered", number, lost)
    except BagError:
        result.refused += 1
    except MemoryError:
        result.fault("out of memory", number, found.change)
    except Exception:
        result.fault("traceback", number, traceback.format_exc().strip().splitlines()[-1])
    taken = time.process_time() - begun
    result.longest_s = max(result.longest_s, taken)
    if taken > SLOW_S:
        result.fault("slow", number, f"{taken:.1f} s")
    said = () if bag is None else [text for text in bag.problems if not _SAYS_NOTHING_OF_MESSAGES.search(text)]
    is_announced = bag is None or not bag.is_complete or bool(said)
    result.reported += bag is not None and (is_announced or not frozenset(bag.problems) <= usual)
    try:
        difference = compared(found, path, bag)
    except NotReadableError:
        return
    result.compared[found.change] += 1
    if difference.wrong and not any("defined in two ways" in text for text in said):
        result.fault("wrong numbers in silence", number, difference.wrong)
    elif difference.missing and not is_announced:
        result.fault("messages lost in silence", number, difference.missing)
    elif difference.extra and not is_announced:
        result.fault("messages made up in silence", number, difference.extra)


def _not_recovered(path: Path, bag: Bag) -> str:
    """Topics of which `recover` writes fewer messages than we read, as text."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        recovery = recover(path, Path(folder) / "out.mcap")
    return ", ".join(name for name, topic in bag.topics.items() if recovery.counts.get(name, 0) < topic.count)


class Difference(NamedTuple):
    """How what we read differs from what another reader does; the first message of each kind as text, or empty."""

    missing: str
    wrong: str
    """A message of the same topic and times has other values."""
    extra: str


def compared(found: Case, path: Path, bag: Bag | None) -> Difference:
    """Compare a bag as we read it, None if we refuse it. Raises NotReadableError if no other reader can."""
    theirs, ours = Counter[Any](), Counter[Any]()
    if found.base == SQLITE3:
        theirs = payloads_by_sqlite(path)
        if bag is not None:
            ours = Counter((topic, data) for topic in bag.topics for data in bag.payloads(topic))
    else:
        theirs = rows_by_mcap(found.data)
        if bag is not None:
            ours = rows_by_us(bag)
    missing, extra = theirs - ours, ours - theirs
    known = {row[:-1] for row in missing} if found.base != SQLITE3 else set()
    wrong = [row for row in extra if row[:-1] in known]
    return Difference(_first(missing), _first(wrong), _first(row for row in extra if row not in wrong))


def _first(rows: Iterable[Any]) -> str:
    return next((str(row)[:300] for row in rows), "")
