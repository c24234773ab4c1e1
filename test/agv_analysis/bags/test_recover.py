"""`recover` writes all that is whole, whether or not this package can decode it, and says what it could not check."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType

from agv_analysis.bags import BagError, read_bag
from agv_analysis.bags.message_batch import NO_DEFINITION
from agv_analysis.bags.recover import recover

Payloads = dict[str, list[tuple[int, bytes]]]
By = Callable[[Path], Payloads]


def test_every_byte_of_every_message_is_recovered(any_bag: Path, by_others: By, tmp_path: Path) -> None:
    original = by_others(any_bag)
    recovery = recover(any_bag, tmp_path / "out")
    assert recovery.is_complete == ("x_2.db3" not in {file.name for file in any_bag.glob("*")})  # a hole in a split
    assert by_others(tmp_path / "out") == original
    assert recovery.counts == {topic: len(messages) for topic, messages in original.items()}
    assert sum(recovery.counts.values()) == 14


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("mcap, empty definitions", NO_DEFINITION),
        ("mcap, no schemas", NO_DEFINITION),
        ("mcap, binary schemas", "its definition is in 'protobuf'; ros2msg and ros2idl are read"),
        ("mcap, another encoding", "they are encoded as 'protobuf'"),
        ("sqlite3 of Humble", NO_DEFINITION),
    ],
)
def test_what_is_copied_unchecked_is_counted_and_named(
    odd_bag: Callable[[str], Path], tmp_path: Path, name: str, reason: str
) -> None:
    recovery = recover(odd_bag(name), tmp_path / "out.mcap")
    assert f"/reading: message copied as it is, unchecked ({reason}): 7" in recovery.problems
    info = read_bag(tmp_path / "out.mcap")
    assert any(problem.startswith("/reading: topic that cannot be decoded") for problem in info.problems)
    with pytest.raises(BagError, match="/reading: cannot be decoded"):
        info["/reading"]
    assert len(info.payloads("/reading")) == 7


def test_messages_that_contradict_their_definition_are_copied_and_counted(
    odd_bag: Callable[[str], Path], tmp_path: Path
) -> None:
    recovery = recover(odd_bag("mcap, wrong definitions"), tmp_path / "out.mcap")
    assert recovery.counts == {"/point": 7, "/reading": 7}
    said = "/point: message that its definition does not describe, copied as it is"
    assert any(problem.startswith(said) and problem.endswith(": 7") for problem in recovery.problems)


def test_definitions_metadata_and_attachments_are_copied_byte_by_byte(
    odd_bag: Callable[[str], Path], tmp_path: Path
) -> None:
    recover(odd_bag("mcap, binary schemas"), tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert {(schema.encoding, schema.data) for schema in summary.schemas.values()} == {("protobuf", b"\xff\xfe\0")}
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("notes", {"a": "1"}), ("notes", {"a": "2"})]
        assert [(a.name, a.media_type, len(a.data)) for a in reader.iter_attachments()] == [
            ("map.png", "image/png", 54)
        ]
        assert {c.topic: c.metadata for c in summary.channels.values()} == {
            t: {"id": t} for t in ("/point", "/reading")
        }


def test_messages_whose_topic_is_not_known_are_recovered(tmp_path: Path, make_record: Callable[..., bytes]) -> None:
    """The record that describes the channel may be what was damaged."""
    body = (1).to_bytes(2, "little") + bytes(4) + (5).to_bytes(8, "little") * 2 + b"\0\1\0\0\7\0\0\0"
    magic = b"\x89MCAP0\r\n"
    parts = [make_record(1, bytes(8)), make_record(5, body), make_record(15, bytes(4)), make_record(2, bytes(20))]
    (tmp_path / "a.mcap").write_bytes(magic + b"".join(parts) + magic)
    recovery = recover(tmp_path / "a.mcap", tmp_path / "out.mcap")
    assert recovery.counts == {"/undescribed_channel_1": 1}
    assert "message of channel 1, which is not described, so that its topic is not known: 1" in recovery.problems
    assert read_bag(tmp_path / "out.mcap").payloads("/undescribed_channel_1") == [b"\0\1\0\0\7\0\0\0"]


# -- records of other kinds -------------------------------------------------------------------------------------------


def records_of(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record of a file, those in chunks that are not compressed too."""
    position = 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        content = data[position + 9 : position + 9 + length]
        yield opcode, content
        if opcode == 6 and content[28:32] == bytes(4):
            yield from records_of(bytes(8) + content[40:] + bytes(8))
        position += 9 + length


def with_foreign(path: Path, make_record: Callable[[int, bytes], bytes]) -> list[tuple[int, bytes]]:
    """Put records of private and unknown kinds into a file: before, in and after chunks, and into the summary."""
    data, position = path.read_bytes(), 8
    parts: list[bytes] = []
    put: list[tuple[int, bytes]] = []

    def new(opcode: int) -> bytes:
        put.append((opcode, f"record {len(put)}".encode() + bytes(len(put))))
        return make_record(*put[-1])

    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        whole = data[position : position + 9 + length]
        if opcode == 6:
            inner = new(0x81) + whole[49:] + new(0x20)
            head = whole[9:25] + struct.pack("<QI", len(inner), zlib.crc32(inner)) + bytes(4)
            whole = make_record(6, head + struct.pack("<Q", len(inner)) + inner)
        if opcode == 2:
            whole = make_record(*put[0]) + new(0x82) + make_record(2, bytes(20))
        parts.append(whole + (new(0x80) if opcode in (1, 6) else b""))
        position += 9 + length
    path.write_bytes(data[:8] + b"".join(parts) + data[-8:])
    return put


@pytest.mark.parametrize("name", ["out.mcap", "out"])
def test_records_of_private_and_unknown_kinds_are_copied_byte_by_byte(
    make_mcap: Callable[..., Path], make_record: Callable[[int, bytes], bytes], tmp_path: Path, by_others: By, name: str
) -> None:
    path = make_mcap(tmp_path / "a.mcap", compression=CompressionType.NONE)
    original = by_others(path)
    put = with_foreign(path, make_record)
    assert {opcode for opcode, _ in put} == {0x20, 0x80, 0x81, 0x82}
    recovery = recover(path, tmp_path / name)
    file = tmp_path / name if name.endswith(".mcap") else tmp_path / name / f"{name}_0.mcap"
    found = list(records_of(file.read_bytes()))
    assert sorted(part for part in found if part[0] >= 16) == sorted(put)
    assert max(found.index(part) for part in put) < [opcode for opcode, _ in found].index(15)  # in the data section
    for opcode, kind in ((0x20, "unknown"), (0x80, "private"), (0x81, "private"), (0x82, "private")):
        count = sum(part[0] == opcode for part in put) + (opcode == put[0][0])
        said = f"record of the {kind} kind {opcode}, copied as it is: {count}"
        assert any(problem.startswith(said) for problem in recovery.problems), recovery.problems
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert [(m.name, m.metadata) for m in reader.iter_metadata()][:2] == [
            ("notes", {"a": "1"}),
            ("notes", {"a": "2"}),
        ]
        assert [a.data for a in reader.iter_attachments()] == [b"\x89PNG" + bytes(50)]
    assert by_others(tmp_path / name) == original  # also compares the CRC of the data section
    copy = read_bag(tmp_path / name)
    assert copy.is_complete
    assert {problem.split(",")[0] for problem in copy.problems} == {
        f"record of the {'private' if opcode >= 0x80 else 'unknown'} kind {opcode}" for opcode, _ in put
    }


def test_metadata_and_attachments_that_a_writer_put_into_chunks_are_not_lost(
    tmp_path: Path, make_mcap: Callable[..., Path], make_record: Callable[[int, bytes], bytes]
) -> None:
    """MCAP does not allow it; nothing of it may be lost all the same."""
    path = make_mcap(tmp_path / "a.mcap", compression=CompressionType.NONE)
    data, position = path.read_bytes(), 8
    parts: list[bytes] = []
    inner_metadata = make_record(12, b"\5\0\0\0inner" + b"\x0a\0\0\0" + b"\1\0\0\0k\1\0\0\0v")
    about = bytes(16) + b"\1\0\0\0f" + b"\1\0\0\0t" + (3).to_bytes(8, "little") + b"abc"
    inner_file = make_record(9, about + bytes(4))
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        whole = data[position : position + 9 + length]
        if opcode == 6 and not any(part[0] == 6 for part in parts):
            inner = whole[49:] + inner_metadata + inner_file
            head = whole[9:25] + struct.pack("<QI", len(inner), zlib.crc32(inner)) + bytes(4)
            whole = make_record(6, head + struct.pack("<Q", len(inner)) + inner)
        parts.append(make_record(2, bytes(20)) if opcode == 2 else whole)
        position += 9 + length
    path.write_bytes(data[:8] + b"".join(parts) + data[-8:])
    assert read_bag(path).metadata["inner"] == {"k": "v"}
    recover(path, tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file)
        assert sorted(m.name for m in reader.iter_metadata()) == ["inner", "notes", "notes"]
        assert sorted(a.data for a in reader.iter_attachments()) == [b"abc", b"\x89PNG" + bytes(50)]


@pytest.mark.parametrize(("name", "distro"), [("sqlite3 of Foxy", ""), ("sqlite3 of Humble", "humble"), ("mcap", "")])
@pytest.mark.parametrize("out", ["out", "out.mcap"])
def test_a_recovered_bag_claims_no_other_distribution(
    odd_bag: Callable[[str], Path], tmp_path: Path, name: str, distro: str, out: str
) -> None:
    """By it a definition that is missing is chosen."""
    recover(odd_bag(name), tmp_path / out)
    assert read_bag(tmp_path / out).distro == distro


def test_custom_data_of_metadata_yaml_is_kept(odd_bag: Callable[[str], Path], tmp_path: Path) -> None:
    path = odd_bag("directory of Humble")
    about = yaml.safe_load((path / "metadata.yaml").read_text())
    about["rosbag2_bagfile_information"]["custom_data"] = {"driver": "Ada", "lap": "7"}
    (path / "metadata.yaml").write_text(yaml.safe_dump(about))
    recover(path, tmp_path / "out")
    copied = yaml.safe_load((tmp_path / "out" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert copied["custom_data"] == {"driver": "Ada", "lap": "7"}
