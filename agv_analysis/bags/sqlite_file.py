"""One sqlite3 file of rosbag2 -> its messages, batch by batch, and everything that is wrong with it.

The file's own table of topics is what counts, whatever metadata.yaml says beside it. A recording that was interrupted
leaves a write-ahead log or a journal, which sqlite3 takes over only where it may write; so it does that in a copy.
A damaged file is read in the order of its rows, and behind each place that cannot be read further on.

Source: rosbag2_storage_sqlite3, its schemas 1 (Dashing) to 4 (Iron and later).
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.bags.bag_errors import BagError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.records import QOS, TYPE_HASH, Attachment, Channel, Foreign, Schema
from agv_analysis.bags.storage import IsWanted, undescribed

_ROWS = 16384
_BYTES = 2**24
"""Messages, and bytes of them, that are passed on together."""

_LEAD = struct.Struct("<qq")

_MOST_SAID = 10
"""Most error messages of sqlite3 that are passed on."""

_MOST_LEAPS = 1000
"""Most places of a damaged file behind which reading goes on."""

_REMEDY = "`sqlite3 FILE .recover | sqlite3 NEW.db3` may recover what is intact"


class SqliteFile:
    """Reads one .db3 file; it knows one time of a message only."""

    def __init__(self, path: Path, keep_all: bool = False) -> None:
        """Open the file. Raises BagError if it cannot be read or is not a database of rosbag2.

        `keep_all`: the messages of topics that are not described, too.
        """
        self.path = path
        self.findings = Findings()
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.attachments: list[Attachment] = []
        self.foreign: list[Foreign] = []
        self.counts: Counter[int] = Counter()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.distro = ""
        self.position = 0
        self._keep_all = keep_all
        self._cleanup = contextlib.ExitStack()
        try:
            self.size = max(1, path.stat().st_size)
            self._database = self._connect()
            self._describe()
        except OSError as error:
            self.close()
            raise BagError(f"{path}: cannot be read: {error.strerror}") from None
        except (sqlite3.Error, ValueError, OverflowError) as error:
            self.close()
            raise BagError(f"{path}: sqlite3 cannot open it: {error}; {_REMEDY}") from None
        except BagError:
            self.close()
            raise
        self.findings.add("storage without checksums, whose content is not checked")

    def close(self) -> None:
        """Close the file."""
        self._cleanup.close()

    def expected(self, channel: int) -> int:
        """Messages that the channel has."""
        return self._expected.get(channel, 0)

    # -- what the file says of itself --------------------------------------------------------------------------------

    def _connect(self) -> sqlite3.Connection:
        logs = [self.path.with_name(self.path.name + ending) for ending in ("-wal", "-journal")]
        logs = [log for log in logs if log.exists() and log.stat().st_size]
        uri = f"{self.path.absolute().as_uri()}?immutable=1"
        if logs:
            folder = Path(self._cleanup.enter_context(tempfile.TemporaryDirectory(prefix="agv_ncs_")))
            for file in (self.path, *logs):
                shutil.copyfile(file, folder / file.name)
                what = f"{file.name}, of a recording that was interrupted, read together with the database"
                if file is not self.path:
                    self.findings.add(what)
            uri = (folder / self.path.name).as_uri()
        database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        self._cleanup.callback(database.close)
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        return database

    def _columns(self, table: str) -> list[str]:
        return [str(row[1]) for row in self._database.execute(f"PRAGMA table_info({table})")]

    def _select(self, table: str, columns: list[str]) -> Iterator[tuple[Any, ...]]:
        """Some columns of a table, empty where it has no such column; no rows if there is no such table."""
        there = self._columns(table)
        if there:
            names = ", ".join(column if column in there else "''" for column in columns)
            yield from self._database.execute(f"SELECT {names} FROM {table} ORDER BY rowid")

    def _describe(self) -> None:
        if not self._columns("topics") or not self._columns("messages"):
            raise BagError(f"{self.path}: a database, but no bag: it lacks rosbag2's tables `topics` and `messages`")
        self.distro = _text(next(self._select("schema", ["ros_distro"]), ("",))[0])
        kinds = self._select("message_definitions", ["topic_type", "encoding", "encoded_message_definition"])
        definitions: dict[str, tuple[str, str]] = {}
        for kind, encoding, text in kinds:
            definitions.setdefault(_text(kind), (_text(encoding), _text(text)))
        wanted = ["id", "name", "type", "serialization_format", QOS, "type_description_hash"]
        for number, name, kind, form, qos, type_hash in self._select("topics", wanted):
            if not isinstance(number, int):
                self.findings.add("row that describes no topic, left out", is_loss=True)
                continue
            encoding, text = definitions.get(_text(kind), ("", ""))
            self.schemas[number] = Schema(number, _text(kind), encoding, text.encode())
            about = {QOS: _text(qos), TYPE_HASH: _text(type_hash)}
            self.channels[number] = Channel(number, number, _text(name), _text(form), about)
        query = "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        self._expected: dict[int, int] = {}
        self._is_sound = self._check()
        with contextlib.suppress(sqlite3.Error):
            found = self._database.execute(query).fetchall()
            self._expected = {number: count for number, count in found if isinstance(number, int)}

    def _check(self) -> bool:
        """Does sqlite3 itself find nothing wrong with the file? What it finds is reported."""
        try:
            found = [str(row[0]) for row in self._database.execute(f"PRAGMA integrity_check({_MOST_SAID})")]
        except (sqlite3.Error, ValueError, OverflowError) as error:
            found = [str(error)]
        wrong = [text for text in found if text != "ok"]
        for text in wrong:
            self.findings.add(f"{self.path.name}: database that is damaged ({' '.join(text.split())})", is_loss=True)
        return not wrong

    # -- its messages ------------------------------------------------------------------------------------------------

    def batches(self, is_wanted: IsWanted) -> Iterator[tuple[Channel, Batch]]:
        """The messages of all channels that are wanted, in the order of their times, in batches of one channel.

        If the file is damaged, in the order of its rows.
        """
        total = max(1, sum(self._expected.values()))
        topics: list[int] = []
        messages: list[bytes] = []
        size, numbers = 0, _Numbers()
        for read, (row, topic, time, data) in enumerate(self._rows(), 1):
            numbers.take(row)
            channel = self._channel(topic)
            if channel is None:
                continue
            if not isinstance(time, int) or not isinstance(data, bytes):
                self.findings.add(f"{channel.topic}: row that is not a message, left out", is_loss=True)
                continue
            self.counts[channel.id] += 1
            if is_wanted(channel):
                topics.append(channel.id)
                messages.append(_LEAD.pack(time, time) + data)
                size += len(data)
                if len(messages) == _ROWS or size > _BYTES:
                    self.position = min(self.size, self.size * read // total)
                    yield from self._split(topics, messages)
                    topics, messages, size = [], [], 0
        self.position = self.size
        if messages:
            yield from self._split(topics, messages)
        if numbers.missing:
            what = f"{self.path.name}: message missing from the sequence of its numbers"
            self.findings.add(what, numbers.missing, is_loss=True)

    def _channel(self, topic: object) -> Channel | None:
        """The channel with the number of a row; None if there is none and its messages are not kept."""
        number = topic if isinstance(topic, int) else -1
        if number in self.channels:
            return self.channels[number]
        what = f"message of topic {topic!r:.20}, which is not described, so that its name is not known"
        self.findings.add(what, is_loss=True)
        return undescribed(number) if self._keep_all else None

    def _rows(self) -> Iterator[tuple[Any, Any, Any, Any]]:
        """Number, topic, time and data of each message."""
        if self._is_sound:
            query = "SELECT id, topic_id, timestamp, data FROM messages ORDER BY timestamp"
            try:
                yield from self._database.execute(query)
            except (sqlite3.Error, OverflowError) as error:
                self.findings.add(f"{self.path.name}: end of what sqlite3 can read ({error})", is_loss=True)
            return
        query = "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED WHERE rowid >= ? ORDER BY rowid"
        next_row, leap, last = -(2**63), 1, self._last_row()
        for _ in range(_MOST_LEAPS):
            try:
                for row in self._database.execute(query, (next_row,)):
                    next_row, leap = row[0] + 1, 1
                    yield row
                return
            except (sqlite3.Error, OverflowError):
                next_row = max(next_row, 0) + leap
                leap *= 2
                if next_row > last:
                    break
        self.findings.add(f"{self.path.name}: rest of a damaged database, not read", is_loss=True)

    def _last_row(self) -> int:
        try:
            return int(self._database.execute("SELECT max(rowid) FROM messages").fetchone()[0] or 0)
        except (sqlite3.Error, TypeError, ValueError):
            return 0

    def _split(self, topics: list[int], messages: list[bytes]) -> Iterator[tuple[Channel, Batch]]:
        """Messages, in one buffer, by their channels."""
        buffer = np.frombuffer(b"".join(messages), np.uint8)
        sizes = np.array([len(message) for message in messages], np.int64)
        starts, owner = np.cumsum(sizes) - sizes, np.array(topics, np.int64)
        for number in dict.fromkeys(topics):
            mine = owner == number
            yield self.channels.get(number) or undescribed(number), Batch(buffer, starts[mine], sizes[mine])


def _text(value: object) -> str:
    """A text as it should be; what else a cell may hold is made one."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return "" if value is None else str(value)


class _Numbers:
    """The numbers of the messages, which a recorder gives one after the other."""

    def __init__(self) -> None:
        self._first, self._last, self._count = 2**63, -(2**63), 0

    def take(self, row: object) -> None:
        """Note a number."""
        if isinstance(row, int):
            self._first, self._last, self._count = min(self._first, row), max(self._last, row), self._count + 1

    @property
    def missing(self) -> int:
        """How many numbers between the first and the last have no message."""
        return self._last - self._first + 1 - self._count if self._count else 0
