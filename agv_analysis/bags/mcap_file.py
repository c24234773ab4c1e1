"""One MCAP file -> its messages, batch by batch, with everything that is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from agv_analysis.bags.batch import Batch, Bytes, Ints
from agv_analysis.bags.chunk import (
    Definition,
    Messages,
    by_channel,
    find_messages,
    numbers_at,
    open_chunk,
    parse_chunk,
    parse_index,
    walk_messages,
)
from agv_analysis.bags.errors import BagError, DamagedError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.records import (
    CHANNEL,
    CHUNK,
    FOOTER,
    FOOTER_SIZE,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    METADATA,
    RECORD,
    SCHEMA,
    STATISTICS,
    Channel,
    Schema,
    Statistics,
    parse_channel,
    parse_footer,
    parse_metadata,
    parse_schema,
    parse_statistics,
)

_WINDOW = 2**20


class McapFile:
    """Reads one MCAP file from its first record to its last."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.findings = Findings()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.statistics: Statistics | None = None
        self.found: dict[int, int] = {}
        """Messages found so far by channel."""
        try:
            self._file = path.open("rb")
            self._size = path.stat().st_size
        except OSError as error:
            raise BagError(f"{path}: cannot be read: {error.strerror}") from None
        begin = self._read(0, len(MAGIC))
        if begin != MAGIC:
            found = f"begins with {begin.hex(' ')}" if begin else "is empty"
            raise BagError(f"{path}: {found}; an MCAP file begins with {MAGIC.hex(' ')}")
        self._read_summary()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, offset: int, count: int) -> bytes:
        """Up to `count` bytes at `offset`; fewer at the end of the file."""
        try:
            self._file.seek(offset)
            return self._file.read(max(0, min(count, self._size - offset)))
        except OSError as error:
            raise BagError(f"{self.path}: cannot be read at byte {offset}: {error.strerror}") from None

    def _read_summary(self) -> None:
        end = self._size - len(MAGIC) - FOOTER_SIZE
        try:
            opcode, content = self._record(end)
            footer = parse_footer(content) if opcode == FOOTER else None
        except DamagedError:
            footer = None
        if footer is None:
            self.findings.add("footer missing: the file was not closed, or cut", is_loss=True)
            return
        position = footer.summary_start
        while 0 < position < end:
            try:
                opcode, content = self._record(position)
            except DamagedError:
                return
            self._define(Definition(opcode, content))
            position += RECORD.size + len(content)

    def _record(self, position: int) -> tuple[int, bytes]:
        """Opcode and content of the record at `position`. Raises DamagedError."""
        head = self._read(position, RECORD.size) if position > 0 else b""
        if len(head) < RECORD.size:
            raise DamagedError("the file ends")
        opcode, length = RECORD.unpack(head)
        if position + RECORD.size + length > self._size:
            raise DamagedError(f"a record of {length} bytes where the file has {self._size - position} left")
        return opcode, self._read(position + RECORD.size, length)

    def _define(self, definition: Definition) -> None:
        opcode, content = definition
        try:
            if opcode == SCHEMA:
                schema = parse_schema(content)
                self.schemas.setdefault(schema.id, schema)
            elif opcode == CHANNEL:
                channel = parse_channel(content)
                self.channels.setdefault(channel.id, channel)
            elif opcode == METADATA:
                self.metadata.update([parse_metadata(content)])
            elif opcode == STATISTICS:
                self.statistics = parse_statistics(content)
        except DamagedError as error:
            self.findings.add(f"damaged record ({error})")

    def batches(self, is_wanted: Callable[[Channel], bool]) -> Iterator[tuple[Channel, Batch]]:
        """The messages of all channels that are wanted, in file order, in batches of one channel."""
        position = len(MAGIC)
        waiting: tuple[int, bytes] | None = None
        index: list[Ints] = []
        while position < self._size - len(MAGIC):
            try:
                opcode, content = self._record(position)
            except DamagedError as error:
                self.findings.add(f"not a record ({error})", at=position, is_loss=True)
                break
            if opcode == MESSAGE_INDEX:
                index.append(parse_index(content))
            elif waiting is not None:
                yield from self._chunk(*waiting, index, is_wanted)
                waiting, index = None, []
            if opcode == CHUNK:
                waiting = position, content
            elif opcode == MESSAGE:
                window = self._read(position, max(_WINDOW, RECORD.size + len(content)))
                messages, _, _ = walk_messages(window)
                yield from self._split(np.frombuffer(window, np.uint8), messages, is_wanted)
                content = window[: int(messages.starts[-1] + messages.lengths[-1])]
            else:
                self._define(Definition(opcode, content))
            position += RECORD.size + len(content)
        if waiting is not None:
            yield from self._chunk(*waiting, index, is_wanted)

    def _chunk(
        self, position: int, record: bytes, index: list[Ints], is_wanted: Callable[[Channel], bool]
    ) -> Iterator[tuple[Channel, Batch]]:
        try:
            chunk = parse_chunk(record)
            content = open_chunk(chunk)
        except DamagedError as error:
            number = sum(map(len, index))
            self.findings.add(f"damaged chunk left out ({error})", at=position, messages=number, is_loss=True)
            return
        if not chunk.crc:
            self.findings.add("chunk without a CRC, not checked")
        buffer = np.frombuffer(content, np.uint8)
        found = find_messages(buffer, index)
        if found is None:
            messages, definitions, end = walk_messages(content)
            if end != len(content):
                self.findings.add("chunk that ends in no record", at=position, is_loss=True)
        else:
            messages, definitions = found
        for definition in definitions:
            self._define(definition)
        yield from self._split(buffer, messages, is_wanted)

    def _split(
        self, buffer: Bytes, messages: Messages, is_wanted: Callable[[Channel], bool]
    ) -> Iterator[tuple[Channel, Batch]]:
        for number, mine in by_channel(messages):
            self.found[number] = self.found.get(number, 0) + len(mine.starts)
            channel = self.channels.get(number)
            if channel is None:
                self.findings.add(
                    f"message of channel {number}, which is not described", len(mine.starts), is_loss=True
                )
            elif is_wanted(channel):
                yield channel, _batch(buffer, mine)


def _batch(buffer: Bytes, messages: Messages) -> Batch:
    head = MESSAGE_HEAD.size
    starts = messages.starts
    log_time = numbers_at(buffer, starts + head - 16, "<i8")
    publish_time = numbers_at(buffer, starts + head - 8, "<i8")
    return Batch(buffer, starts + head, messages.lengths - (head - RECORD.size), log_time, publish_time)
