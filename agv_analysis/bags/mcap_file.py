"""One MCAP file -> its messages, batch by batch, and everything that is wrong with it.

Theory of operation. The file is read once, from its first record to its last; no index is needed for that, nor is one
believed. The lengths inside each record must add up to its own, or to less if another record follows: what is behind
its last field is then what a newer version of MCAP has added, as are records of unknown kinds. Where they do not, the
chunk that it may be is tried first (`rescue_chunk`), then the next record is searched for, and what lies between is
reported. What a CRC
covers is used only if it matches; what none covers is used and reported as not checked. Message indexes are hints for
finding the messages of a chunk fast (`chunk.find`). Definitions of topics are taken from the place that a CRC covers,
where there is one: the summary at the end of the file repeats those of the chunks.

Chunks are inflated and checked on a thread of their own, a few ahead of the messages being sorted out: both let go of
Python's lock.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from agv_analysis.bags.bag_errors import BagError, DamagedError
from agv_analysis.bags.checksum import crc32
from agv_analysis.bags.chunk import (
    Content,
    Definition,
    Messages,
    by_channel,
    cut_chunk,
    is_as_declared,
    is_wrong_length,
    messages_at,
    open_chunk,
    rescue_chunk,
    run_of_messages,
    walk,
)
from agv_analysis.bags.definitions import Definitions
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.layout import LEAD
from agv_analysis.bags.message_batch import Batch, Bytes
from agv_analysis.bags.open_ahead import Cut, Item, Opened, Packed, Run, open_ahead
from agv_analysis.bags.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    DATA_END_SIZE,
    DATA_KINDS,
    FOOTER,
    FOOTER_SIZE,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    METADATA,
    PRIVATE,
    RECORD,
    SCHEMA,
    STATISTICS,
    Attachment,
    Channel,
    Footer,
    Foreign,
    Schema,
    Statistics,
    has_shape,
    is_known,
    parse_attachment,
    parse_chunk,
    parse_footer,
    parse_index,
    parse_metadata,
    parse_statistics,
)
from agv_analysis.bags.source import Record, Source
from agv_analysis.bags.storage import IsWanted, is_large, undescribed

_DISTRO = re.compile(r"^ros_distro:\s*['\"]?(\w+)", re.MULTILINE)

_WINDOW = 2**20

EXTENDED = "record with bytes after the last field that is known here, these ignored"

_LONGEST_FOOTER = 2**12
"""Bytes before the end in which a footer with more fields than today's is looked for."""

_MAX_DAMAGES = 10_000
"""Damaged places of a file that are skipped, at most."""


def _has_shape(record: Record, opcode: int) -> bool:
    content = record.content
    return has_shape(opcode, len(content), lambda at, count: content[at : at + count])


class McapFile:
    """Reads one MCAP file. Everything but the batches is complete only after these have been read."""

    def __init__(self, path: Path, keep_all: bool = False) -> None:
        """Open the file. Raises BagError if it cannot be read or is not an MCAP file.

        `keep_all`: attachments, records of unknown kinds, and the messages of channels that are not described, whose
        topic is unknown.
        """
        self.path = path
        self.findings = Findings()
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.attachments: list[Attachment] = []
        self.foreign: list[Foreign] = []
        self.statistics: Statistics | None = None
        self.counts: Counter[int] = Counter()
        """Messages found by channel."""
        self.position = 0
        """How far the file has been read [B]."""
        self._keep_all = keep_all
        self._definitions = Definitions(self.findings)
        self._is_proven = False
        self._is_behind_data = False
        self._damages = 0
        self._source = Source(path)
        try:
            self._check_magic()
            self._read_summary()
        except BagError:
            self.close()
            raise

    @property
    def schemas(self) -> dict[int, Schema]:
        """Schemas by number."""
        return self._definitions.schemas

    @property
    def channels(self) -> dict[int, Channel]:
        """Channels by number."""
        return self._definitions.channels

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._source.size

    @property
    def distro(self) -> str:
        """ROS distribution of the recorder, empty if the file does not say."""
        about = next((content for name, content in self.metadata if name == "rosbag2"), {})
        found = _DISTRO.search(about.get("serialized_metadata", ""))
        return found[1] if found else ""

    def expected(self, channel: int) -> int:
        """Messages of a channel according to the file's statistics, 0 if it has none."""
        return self.statistics.by_channel.get(channel, 0) if self.statistics else 0

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def batches(self, is_wanted: IsWanted) -> Iterator[tuple[Channel, Batch]]:
        """The messages of all channels that are wanted, in file order, in batches of one channel. To be called once."""
        for item, opened in open_ahead(self._items(), is_large=is_large(self.size)):
            self.position = item.position
            if isinstance(item, Run):
                if not self._is_proven:
                    self.findings.add_unchecked("messages outside of chunks", len(item.starts))
                buffer = np.frombuffer(item.content, np.uint8)
                messages = messages_at(buffer, np.array(item.starts, np.int64))
                yield from self._split(buffer, by_channel(buffer, messages), is_wanted)
            elif isinstance(item, Cut):
                yield from self._content(item.position, item.content, walk(item.content, is_cut=True), False, is_wanted)
            elif isinstance(opened, Opened):
                yield from self._unpack(item, opened, is_wanted)
            elif opened is not None:
                number = sum(len(index.places) for index in item.indexes)
                what = f"damaged chunk, left out ({opened})"
                self.findings.add(what, at=item.position, messages=number, is_loss=True)
        self.position = self.size
        self._compare_with_statistics()

    # -- beginning and end of the file -------------------------------------------------------------------------------

    def _check_magic(self) -> None:
        begin = self._source.read(0, len(MAGIC))
        if begin == MAGIC:
            return
        if not begin:
            raise BagError(f"{self.path}: is empty")
        if not (self._source.is_record(len(MAGIC)) and self._source.head(len(MAGIC))[0] == HEADER):
            raise BagError(
                f"{self.path}: is not an MCAP file: begins with {begin.hex(' ')} instead of {MAGIC.hex(' ')}"
            )
        self.findings.add(f"file that begins with {begin.hex(' ')} instead of {MAGIC.hex(' ')}")

    def _read_summary(self) -> None:
        """Definitions and statistics from the end of the file, where they are available before the first message."""
        end = self._footer_position()
        footer = self._footer(end)
        if footer is None:
            return
        begin = footer.summary_start or end
        if not len(MAGIC) <= begin <= end:
            self.findings.add("footer that points to no place in the file")
            return
        is_proven = footer.crc != 0
        if is_proven and self._crc(begin, end + RECORD.size + 16) != footer.crc:
            self.findings.add("summary that does not match its CRC, its statistics not used", at=begin)
            is_proven = False
        self._check_data_section(begin - DATA_END_SIZE)
        for record in self._sound_records(begin, end):
            if record.opcode == STATISTICS and (is_proven or not footer.crc):
                self.statistics = parse_statistics(record.content)
            elif record.opcode in (SCHEMA, CHANNEL):
                self._note(record.opcode, record.content, is_proven, record.position)
        if self.statistics is None:
            self.findings.add("file without statistics, in which a missing message would go undetected")

    def _footer_position(self) -> int:
        """Where the footer is, if there is one: at its place, or before it, if a newer version has added fields."""
        end = self._source.size - len(MAGIC)
        usual = end - FOOTER_SIZE
        if usual >= len(MAGIC) and self._source.read(usual, 1)[0] != FOOTER:
            begin = max(len(MAGIC), usual - _LONGEST_FOOTER)
            tail = self._source.read(begin, end - begin)
            for at in range(len(tail) - RECORD.size, -1, -1):
                if tail[at] == FOOTER and RECORD.unpack_from(tail, at)[1] == end - begin - at - RECORD.size:
                    return begin + at
        return usual

    def _footer(self, position: int) -> Footer | None:
        record = next(self._sound_records(position, position + 1), None)
        if record is not None and record.opcode == FOOTER:
            if self._source.read(record.end, len(MAGIC)) != MAGIC:
                self.findings.add("file whose last eight bytes are not those of an MCAP file")
            return parse_footer(record.content)
        self.findings.add("file without an end: the recording was interrupted, or the file was cut", is_loss=True)
        return None

    def _sound_records(self, position: int, end: int) -> Iterator[Record]:
        """Records from `position` on, up to `end` or to the first that is damaged."""
        while len(MAGIC) <= position < end:
            try:
                record = self._source.record(position)
            except DamagedError:
                return
            yield record
            position = record.end

    def _crc(self, begin: int, end: int) -> int:
        crc = 0
        for position in range(begin, end, _WINDOW):
            crc = crc32(self._source.read(position, min(_WINDOW, end - position)), crc)
        return crc

    def _check_data_section(self, end: int) -> None:
        """Compare the CRC over everything before the DataEnd record at `end`, if there is one."""
        record = next(self._sound_records(end, end + 1), None)
        if record is not None and record.opcode == DATA_END:
            self._compare_data_section(record)

    def _compare_data_section(self, record: Record) -> None:
        """Compare the CRC that a DataEnd record holds, if it does."""
        if not any(record.content[:4]):
            return
        if self._crc(0, record.position) == int.from_bytes(record.content[:4], "little"):
            self._is_proven = True
        else:
            self.findings.add("data section that does not match its CRC", is_loss=True)

    def _compare_with_statistics(self) -> None:
        if self.statistics is None:
            return
        for number, expected in self.statistics.by_channel.items():
            channel = self.channels.get(number)
            name = channel.topic if channel else f"channel {number}"
            found = self.counts[number]
            if found < expected:
                what = f"{name}: message that the recorder counted and that is not there any more"
                self.findings.add(what, expected - found, is_loss=True)
            elif found > expected:
                self.findings.add(f"{name}: message more than the recorder counted", found - expected)

    # -- records -----------------------------------------------------------------------------------------------------

    def _items(self) -> Iterator[Item]:
        """What holds messages, chunks together with their message indexes; all else is taken note of on the way."""
        packed: Packed | None = None
        for item in self._records():
            if isinstance(item, Record) and item.opcode == MESSAGE_INDEX and packed is not None:
                self._take(item, packed)
                continue
            if packed is not None:
                yield packed
                packed = None
            if isinstance(item, Packed):
                packed = item
            elif isinstance(item, Record):
                self._take(item, None)
            else:
                yield item
        if packed is not None:
            yield packed

    def _take(self, record: Record, packed: Packed | None) -> None:
        """Take note of a record outside of chunks that holds no messages."""
        if record.opcode == MESSAGE_INDEX and packed is not None:
            try:
                packed.indexes.append(parse_index(record.content))
            except DamagedError as error:
                self._refuse(error, record.position)
            return
        if record.opcode == DATA_END:
            self._is_behind_data = True
            if record.extra:  # not where it was looked for
                self._compare_data_section(record)
        # The CRC of the data section says nothing of the summary, which has one of its own.
        is_proven = self._is_proven and not self._is_behind_data
        self._note(record.opcode, record.content, is_proven, record.position)

    def _note(self, opcode: int, content: bytes, is_proven: bool, position: int) -> None:
        """Take note of what a record holds, wherever it lies; `is_proven`: a CRC covers it."""
        try:
            if not is_known(opcode):
                self._keep(Foreign(opcode, content), position)
            elif opcode in (SCHEMA, CHANNEL):
                self._definitions.add(Definition(opcode, content), is_proven)
            elif opcode == METADATA:
                self.metadata.append(parse_metadata(content))
                if not is_proven:
                    self.findings.add_unchecked("metadata records")
            elif opcode == ATTACHMENT:
                self._take_attachment(content, position)
        except DamagedError as error:
            self._refuse(error, position)

    def _refuse(self, error: DamagedError, position: int) -> None:
        self.findings.add(f"damaged record, not used ({error})", at=position)

    def _keep(self, record: Foreign, position: int) -> None:
        """Keep a record of a kind that is not known here; the summary may repeat those of the data section."""
        kind = "private" if record.opcode >= PRIVATE else "unknown"
        done = "copied as it is" if self._keep_all else "passed over"
        self.findings.add(f"record of the {kind} kind {record.opcode}, {done}", at=position)
        if self._keep_all and not (self._is_behind_data and record in self.foreign):
            self.foreign.append(record)

    def _take_attachment(self, content: bytes, position: int) -> None:
        attachment, crc, covered = parse_attachment(content)
        if crc and crc32(content[:covered]) != crc:
            self.findings.add("attachment that does not match its CRC, left out", at=position, is_loss=True)
        else:
            self.attachments.append(attachment if self._keep_all else attachment._replace(content=b""))

    def _records(self) -> Iterator[Record | Item]:
        """Everything sound in the file, in order; what is not is passed over and reported."""
        position = len(MAGIC)
        while not self._source.is_end(position):
            item: Record | Item | None
            try:
                item, position = self._next(position)
            except DamagedError as error:
                self._damages += 1
                if self._damages > _MAX_DAMAGES:
                    self.findings.add("rest of a file with too much damage, not read", at=position, is_loss=True)
                    return
                item, position = self._pass_over(position, str(error))
            if item is not None:
                yield item

    def _next(self, position: int) -> tuple[Record | Run | Packed | None, int]:
        """What is at `position`, and where it ends. Raises DamagedError."""
        record = self._source.record(position)
        if record.extra:
            if record.opcode != CHUNK and (packed := self._disguised(record)):
                return packed, record.end
            self._doubt(record)
            self.findings.add(EXTENDED, at=position)
        if record.opcode == MESSAGE:
            return self._run(record)
        if record.opcode == CHUNK:
            return self._packed(record)
        if not is_known(record.opcode) and (packed := self._disguised(record)):
            return packed, record.end
        if not is_known(record.opcode) and not self._source.is_followed(record.end):
            raise DamagedError(f"a record of the unknown kind {record.opcode}")
        return record, record.end

    def _disguised(self, record: Record) -> Packed | None:
        """The chunk that a record is whose opcode says otherwise; None if it has not the shape of one."""
        if not _has_shape(record, CHUNK):
            return None
        self.findings.add("chunk under another opcode", at=record.position)
        return Packed(record.position, parse_chunk(record.content), [])

    def _doubt(self, record: Record) -> None:
        """Raise DamagedError if bytes after a record's last field look like a wrong opcode or a wrong inner length."""
        if any(_has_shape(record, kind) for kind in DATA_KINDS if (kind ^ record.opcode).bit_count() == 1):
            raise DamagedError("a record of another shape than its kind")
        if record.opcode == CHUNK:
            open_chunk(parse_chunk(record.content))

    def _packed(self, record: Record) -> tuple[Packed, int]:
        """A chunk with the sound message indexes that follow it, and where they end."""
        packed, position = Packed(record.position, parse_chunk(record.content), []), record.end
        while (found := self._source.index(position)) is not None:
            index, position = found
            packed.indexes.append(index)
        return packed, position

    def _run(self, first: Record) -> tuple[Run, int]:
        """Messages outside of chunks, as many as follow each other within a window, and where the next record is."""
        position = first.position
        content = self._source.read(position, max(_WINDOW, first.end - position))
        starts, length = run_of_messages(content, 0)
        end = position + length
        if self._source.is_record(end, depth=0) or self._source.is_followed(end):
            return Run(position, content, starts), end
        after = self._source.next_record(position + starts[-1])
        if after is not None and is_wrong_length(position + starts[-1], end, after):
            at = position + starts.pop()
            self.findings.add("message of a wrong length, left out", at=at, messages=1, is_loss=True)
            return Run(position, content, starts), after
        return Run(position, content, starts), end

    def _pass_over(self, position: int, why: str) -> tuple[Packed | Cut | None, int]:
        """What can be recovered at a damaged place, and where the next record is."""
        begin = position + RECORD.size
        left = self._source.size - begin
        head = self._source.read(position, RECORD.size)
        if left > 0:
            _, length = RECORD.unpack(head)

            def read(at: int, count: int) -> bytes:
                return self._source.read(begin + at, count)

            rescued = rescue_chunk(length, left, read)
            if rescued is not None:
                self.findings.add("chunk whose lengths contradict each other, read all the same", at=position)
                return Packed(position, rescued[0], []), begin + rescued[1]
            content = cut_chunk(length, left, read)
            if content is not None:
                self.findings.add("chunk within which the file ends", at=position, is_loss=True)
                return Cut(position, content), self._source.size
        after = self._source.next_record(position)
        if after is None:
            what = "rest of the file, searched no further" if self._source.has_given_up else "end without a record"
            self.findings.add(f"{what} ({why})", at=position, is_loss=True)
            return None, self._source.size
        self.findings.add(f"damaged place, passed over ({why})", at=position, is_loss=True)
        return None, after

    # -- chunks ------------------------------------------------------------------------------------------------------

    def _unpack(self, packed: Packed, opened: Opened, is_wanted: IsWanted) -> Iterator[tuple[Channel, Batch]]:
        chunk, position = packed.chunk, packed.position
        content, found, is_indexed = opened
        if not chunk.crc:
            self.findings.add_unchecked("chunks")
        elif not is_as_declared(chunk, content):
            self.findings.add("chunk that misstates its size or compression, read all the same", at=position)
        if packed.indexes and not is_indexed:
            self.findings.add("message index that does not fit its chunk, not used", at=position)
        yield from self._content(position, content, found, chunk.crc != 0, is_wanted)

    def _content(
        self, position: int, content: bytes, found: Content, is_proven: bool, is_wanted: IsWanted
    ) -> Iterator[tuple[Channel, Batch]]:
        if found.lost:
            self.findings.add("byte in a chunk that belongs to no whole record", found.lost, at=position, is_loss=True)
        for definition in found.definitions:
            self._note(definition.opcode, definition.content, is_proven, position)
        yield from self._split(np.frombuffer(content, np.uint8), found.messages, is_wanted)

    def _split(
        self, buffer: Bytes, messages: dict[int, Messages], is_wanted: IsWanted
    ) -> Iterator[tuple[Channel, Batch]]:
        lead, channels = RECORD.size + MESSAGE_HEAD - LEAD, self.channels
        for number, mine in messages.items():
            channel = channels.get(number)
            if channel is None:
                what = f"message of channel {number}, which is not described, so that its topic is not known"
                self.findings.add(what, len(mine.starts), is_loss=True)
                if not self._keep_all:
                    continue
                channel = undescribed(number)
            self.counts[number] += len(mine.starts)
            if is_wanted(channel):
                yield channel, Batch(buffer, mine.starts + lead, mine.lengths - (MESSAGE_HEAD - LEAD))
