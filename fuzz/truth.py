"""What independent readers find in a bag: mcap with mcap-ros2-support, or sqlite3."""

from __future__ import annotations

import contextlib
import sqlite3
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap_ros2.decoder import DecoderFactory

from agv_analysis.bags import Bag

MESSAGE_HEAD = 22

Values = tuple[tuple[str, Any], ...]
Row = tuple[str, int, int, Values]
"""Topic, log time, publish time, and the values by their paths."""


class NotReadableError(Exception):
    """The independent reader refuses the bag, or would have to guess."""


def rows_by_mcap(data: bytes) -> Counter[Row]:
    """All messages of an MCAP file, decoded. Raises NotReadableError."""
    try:
        return Counter(_rows(data))
    except Exception as error:  # the libraries raise whatever their own parsers do
        raise NotReadableError(repr(error)) from None


def _rows(data: bytes) -> Iterator[Row]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    factory = DecoderFactory()
    for record in _records(data):
        if isinstance(record, Schema):
            _once(schemas, record)
        elif isinstance(record, Channel):
            _once(channels, record)
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            decode = factory.decoder_for(channel.message_encoding, schemas[channel.schema_id])
            if decode is None:
                raise NotReadableError("no decoder")
            values = tuple(sorted(flat(decode(record.data)), key=lambda pair: pair[0]))
            yield channel.topic, record.log_time, record.publish_time, values


def _once(known: dict[int, Any], record: Any) -> None:
    """A definition that another one of its number contradicts is left to its reader."""
    if known.setdefault(record.id, record) != record:
        raise NotReadableError("defined in two ways")


def _records(data: bytes) -> Iterator[Any]:
    for record in StreamReader(BytesIO(data), emit_chunks=True).records:
        if isinstance(record, Chunk):
            yield from _in_chunk(record)
        else:
            yield record


def _in_chunk(chunk: Chunk) -> Iterator[Any]:
    """Records of a chunk, each by its own length: the library would misread what follows one with more fields."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    while stream.count < size:
        opcode, length = stream.read1(), stream.read8()
        content = stream.read(length)
        if len(content) < length or (opcode == Opcode.MESSAGE and length < MESSAGE_HEAD):
            raise NotReadableError("a record that is cut")
        inner = ReadDataStream(BytesIO(content))
        if opcode == Opcode.MESSAGE:
            yield Message.read(inner, length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield (Schema if opcode == Opcode.SCHEMA else Channel).read(inner)


def flat(message: Any, path: str = "", index: tuple[int, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Values of a decoded message by path and index; how long lists are, these say themselves."""
    if hasattr(message, "__slots__"):
        for name in message.__slots__:
            if name != "structure_needs_at_least_one_member":
                yield from flat(getattr(message, name), f"{path}.{name}" if path else name, index)
    elif isinstance(message, list | tuple | np.ndarray | bytes | bytearray):
        for i, value in enumerate(message):
            yield from flat(value, path, (*index, i))
    else:
        yield f"{path}{list(index)}", plain(message)


def plain(value: Any) -> Any:
    """A value such that equal ones are equal: a NaN too, a bool and its number, a text and its bytes."""
    if isinstance(value, str):
        return value.encode().rstrip(b"\0")
    if isinstance(value, float | np.floating):
        return "nan" if value != value else float(value)
    return int(value) if isinstance(value, bool | int | np.integer) else value


def rows_by_us(bag: Bag) -> Counter[Row]:
    """The same of what we have read."""
    found: Counter[Row] = Counter()
    for topic, rows in bag.arrays.items():
        names = [name for name in rows.dtype.names or () if not name.endswith("time_ns")]
        for row in rows:
            values = dict(_cells(row, names))
            pairs = tuple(sorted(values.items(), key=lambda pair: pair[0]))
            times = int(row["log_time_ns"]) % 2**64, int(row["publish_time_ns"]) % 2**64
            found[topic, times[0], times[1], pairs] += 1
    return found


def _cells(row: Any, names: list[str]) -> Iterator[tuple[str, Any]]:
    """Values of a row by path and index, without those that only fill it up."""
    lengths = {name[4:-1]: row[name] for name in names if name.startswith("len(")}
    for name in names:
        if name.startswith("len("):
            continue
        around = _sequences(name, lengths)
        for index in np.ndindex(np.shape(row[name])):
            if all(i < int(np.asarray(length)[index[:depth]]) for depth, (i, length) in _levels(index, around)):
                yield f"{name}{list(index)}", plain(row[name][index] if index else row[name])


def _sequences(path: str, lengths: dict[str, Any]) -> list[Any]:
    """The lengths of the sequences around the values of a path, the outermost first."""
    parts = path.split(".")
    return [lengths[stem] for i in range(len(parts)) for stem in [".".join(parts[: i + 1])] if stem in lengths]


def _levels(index: tuple[int, ...], around: list[Any]) -> Iterator[tuple[int, tuple[int, Any]]]:
    """Each sequence with the index into it and how many indices are before that."""
    for length in around:
        depth = np.ndim(length)
        yield depth, (index[depth], length)


def payloads_by_sqlite(path: Path) -> Counter[tuple[str, bytes]]:
    """Topic and payload of each message of a database. Raises NotReadableError."""
    try:
        with contextlib.closing(sqlite3.connect(f"{path.as_uri()}?immutable=1", uri=True)) as database:
            if database.execute("PRAGMA integrity_check").fetchall() != [("ok",)]:
                raise NotReadableError("its integrity check fails")
            rows = database.execute("SELECT name, data FROM messages JOIN topics ON topics.id = topic_id").fetchall()
    except (sqlite3.Error, ValueError, OverflowError) as error:
        raise NotReadableError(repr(error)) from None
    return Counter((str(topic), data) for topic, data in rows if isinstance(data, bytes))
