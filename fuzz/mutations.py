"""What is done to a bag: to its bytes, or to its records, whose lengths and checksums are then put right again.

Random bytes hardly ever pass a checksum, so that they try one line of the reader again and again. Behind records whose
checksums are right stand all its other lines.
"""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
FOOTER, CHUNK, DATA_END = 2, 6, 15

HINTS = (7, 8, 11)
"""Message indexes, chunk indexes and statistics."""


class Record(NamedTuple):
    """A record of an MCAP file; of a chunk the content is that before its records, which are in `inner`."""

    opcode: int
    content: bytes
    inner: tuple[Record, ...] | None = None
    compression: str = ""


def records_of(data: bytes) -> list[Record]:
    """The records of a sound file, those in chunks too."""
    found, position = [], len(MAGIC)
    while position < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, position)
        found.append(_opened(opcode, data[position + 9 : position + 9 + length]))
        position += 9 + length
    return found


def _opened(opcode: int, content: bytes) -> Record:
    if opcode != CHUNK:
        return Record(opcode, content)
    (size,), (name_length,) = struct.unpack_from("<Q", content, 16), struct.unpack_from("<I", content, 28)
    compression, packed = content[32 : 32 + name_length].decode(), content[32 + name_length + 8 :]
    if compression == "zstd":
        packed = zstandard.decompress(packed, size)
    elif compression == "lz4":
        packed = lz4.frame.decompress(packed)
    inner, position = [], 0
    while position < len(packed):
        kind, length = struct.unpack_from("<BQ", packed, position)
        inner.append(Record(kind, packed[position + 9 : position + 9 + length]))
        position += 9 + length
    return Record(opcode, content[:28], tuple(inner), compression)


def file_of(records: list[Record], with_crcs: bool) -> bytes:
    """A file of records, its lengths right, and its checksums too if it is to have any."""
    parts = [MAGIC]
    summary_at = None
    for record in records:
        content = record.content if record.inner is None else _closed(record, with_crcs)
        if record.opcode == DATA_END and len(content) == 4:
            content = struct.pack("<I", zlib.crc32(b"".join(parts)) if with_crcs else 0)
        if record.opcode == FOOTER and len(content) == 20:
            content = _footer(parts, summary_at, content, with_crcs)
        parts.append(struct.pack("<BQ", record.opcode, len(content)) + content)
        if record.opcode == DATA_END:
            summary_at = len(parts)
    return b"".join([*parts, MAGIC])


def _footer(parts: list[bytes], summary_at: int | None, content: bytes, with_crcs: bool) -> bytes:
    if summary_at is None or summary_at == len(parts):
        return struct.pack("<QQI", 0, 0, 0)
    head = struct.pack("<QQ", sum(map(len, parts[:summary_at])), 0)
    covered = b"".join(parts[summary_at:]) + struct.pack("<BQ", FOOTER, 20) + head
    return head + struct.pack("<I", zlib.crc32(covered) if with_crcs else 0)


def _closed(record: Record, with_crcs: bool) -> bytes:
    inner = b"".join(struct.pack("<BQ", one.opcode, len(one.content)) + one.content for one in record.inner or ())
    packed = inner
    if record.compression == "zstd":
        packed = zstandard.compress(inner)
    elif record.compression == "lz4":
        packed = lz4.frame.compress(inner)
    head = record.content[:16] + struct.pack("<QI", len(inner), zlib.crc32(inner) if with_crcs else 0)
    name = record.compression.encode()
    return head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed


# -- bytes ------------------------------------------------------------------------------------------------------------


def change_bytes(draw: random.Random, data: bytes) -> bytes:
    """Flip, overwrite, take out, put in, repeat or cut off, once or several times."""
    found = bytearray(data)
    for _ in range(draw.choice([1, 1, 1, 2, 5])):
        if not found:
            break
        at = draw.randrange(len(found))
        what = draw.randrange(6)
        if what == 0:
            found[at] ^= 1 << draw.randrange(8)
        elif what == 1:
            new = draw.choice([b"\xff" * 8, bytes(8), draw.randbytes(4)])
            found[at : at + len(new)] = new
        elif what == 2:
            del found[at : at + draw.randrange(1, 40)]
        elif what == 3:
            found[at:at] = draw.randbytes(draw.randrange(1, 20))
        elif what == 4:
            found[at:at] = found[at : at + draw.randrange(1, 400)]
        else:
            del found[at:]
    return bytes(found)


# -- records ----------------------------------------------------------------------------------------------------------


def _drop(draw: random.Random, records: list[Record], at: int) -> None:
    del records[at]


def _repeat(draw: random.Random, records: list[Record], at: int) -> None:
    records.insert(draw.randrange(len(records) + 1), records[at])


def _swap(draw: random.Random, records: list[Record], at: int) -> None:
    other = draw.randrange(len(records))
    records[at], records[other] = records[other], records[at]


def _content(draw: random.Random, records: list[Record], at: int) -> None:
    if records[at].content:
        records[at] = records[at]._replace(content=change_bytes(draw, records[at].content))


def _number(draw: random.Random, records: list[Record], at: int) -> None:
    """Put a number of 1, 2, 4 or 8 bytes that is likely to be a border in the place of another one."""
    content, size = bytearray(records[at].content), draw.choice([1, 2, 4, 8])
    if len(content) >= size:
        value = draw.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1, draw.randrange(300)])
        place = draw.randrange(len(content) - size + 1)
        content[place : place + size] = (value % 2 ** (8 * size)).to_bytes(size, "little")
        records[at] = records[at]._replace(content=bytes(content))


def _extend(draw: random.Random, records: list[Record], at: int) -> None:
    records[at] = records[at]._replace(content=records[at].content + draw.randbytes(draw.randrange(1, 30)))


def _opcode(draw: random.Random, records: list[Record], at: int) -> None:
    records[at] = records[at]._replace(opcode=draw.choice([draw.randrange(1, 16), draw.randrange(256)]))


RECORD_CHANGES: dict[str, Callable[[random.Random, list[Record], int], None]] = {
    "drop": _drop, "repeat": _repeat, "swap": _swap, "content": _content, "number": _number, "extend": _extend,
    "opcode": _opcode,
}  # fmt: skip


def change_records(draw: random.Random, data: bytes, with_crcs: bool) -> tuple[str, bytes]:
    """What was done to the records of a file, and the file; in most cases to those in chunks."""
    records = records_of(data)
    chunks = [at for at, record in enumerate(records) if record.inner]
    names = []
    for _ in range(draw.choice([1, 1, 1, 2, 4])):
        name = draw.choice(list(RECORD_CHANGES))
        names.append(name)
        if chunks and draw.random() < 0.7:
            at = draw.choice(chunks)
            inner = list(records[at].inner or ())
            if inner:
                RECORD_CHANGES[name](draw, inner, draw.randrange(len(inner)))
                records[at] = records[at]._replace(inner=tuple(inner))
        elif records:
            RECORD_CHANGES[name](draw, records, draw.randrange(len(records)))
            chunks = [at for at, record in enumerate(records) if record.inner]
    if draw.random() < 0.5:  # else they contradict most changes, and the reader says so
        records = [record for record in records if record.opcode not in HINTS]
    return names[0] if len(names) == 1 else "several", file_of(records, with_crcs)
