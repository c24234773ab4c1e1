"""A part of `make fuzz` that is the same each time, and that the comparison sees what it is there for."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from agv_analysis.bags import Bag, read_bag
from fuzz.bases import NAMES, SQLITE3, base
from fuzz.campaign import Case, Difference, case, compared, little_memory, run
from fuzz.mutations import Record, file_of, records_of
from fuzz.truth import rows_by_mcap


def test_no_case_shows_a_fault(tmp_path: Path) -> None:
    result = run(1, range(50), tmp_path, None)
    assert sum(result.cases.values()) == 50
    assert sum(result.compared.values()) > 10
    assert not result.faults, result.first


def test_no_room_is_made_for_messages_that_a_small_file_cannot_have(tmp_path: Path) -> None:
    """Of a million million that its statistics state."""
    records = records_of(base("without CRCs"))
    at = next(i for i, one in enumerate(records) if one.opcode == 11)
    statistics = bytearray(records[at].content)
    for place in range(46 + 2, len(statistics), 10):  # behind a length, pairs of channel and count
        struct.pack_into("<Q", statistics, place, 10**12)
    (tmp_path / "a.mcap").write_bytes(
        file_of([*records[:at], Record(11, bytes(statistics)), *records[at + 1 :]], False)
    )
    with little_memory():
        bag = read_bag(tmp_path / "a.mcap")
    assert sum(topic.count for topic in bag.topics.values()) == 30
    assert any("message that the recorder counted" in text for text in bag.problems), bag.problems


def test_a_case_is_a_function_of_its_number() -> None:
    assert case(3, 17) == case(3, 17)
    assert len({case(3, number).data for number in range(20)}) > 15


@pytest.mark.parametrize("name", NAMES)
def test_sound_bags_are_read_as_others_read_them(tmp_path: Path, name: str) -> None:
    found = Case(name, "", base(name))
    path = tmp_path / ("a.db3" if name == SQLITE3 else "a.mcap")
    path.write_bytes(found.data)
    assert compared(found, path, read_bag(path)) == Difference("", "", "")
    if name != SQLITE3:
        assert sum(rows_by_mcap(found.data).values()) == 30


@pytest.mark.parametrize("with_crcs", [True, False])
def test_records_taken_apart_and_put_together_are_the_same_bag(with_crcs: bool) -> None:
    for name in ("zstd", "lz4", "none", "unchunked"):
        data = base(name)
        assert rows_by_mcap(file_of(records_of(data), with_crcs)) == rows_by_mcap(data)


def _wrong(bag: Bag) -> None:
    bag.arrays["/pose"]["pose.position.x"][3] += 1e-9


def _missing(bag: Bag) -> None:
    bag.arrays["/joints"] = bag.arrays["/joints"][1:]


def _extra(bag: Bag) -> None:
    bag.arrays["/clock"]["log_time_ns"][0] += 1


@pytest.mark.parametrize(
    ("spoil", "seen"), [(_wrong, {"missing", "wrong"}), (_missing, {"missing"}), (_extra, {"missing", "extra"})]
)
def test_the_comparison_sees_what_is_wrong(tmp_path: Path, spoil: Callable[[Bag], None], seen: set[str]) -> None:
    found = Case("zstd", "", base("zstd"))
    (tmp_path / "a.mcap").write_bytes(found.data)
    bag = read_bag(tmp_path / "a.mcap")
    spoil(bag)
    difference = compared(found, tmp_path / "a.mcap", bag)
    assert {name for name, value in difference._asdict().items() if value} == seen
