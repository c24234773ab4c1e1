"""Speed of reading bags: messages per second of a recording of the loop, decoded to numbers, all of its topics.

The peers read the same file and the same topics: mcap-ros2-support's decoded iteration, rosbags' raw iteration with its
CDR decoder, the mcap library's bare iteration, and, for what no reader can do without, its decompression alone. Reading
here includes the checksums, which none of the peers compares. The peers that are slow read the first messages only.
An export is measured as its user has it, as a whole process from the start of Python on.

The bag is made here: one chunk of a real recording of the loop, again and again, its stamps moved on.
"""

from __future__ import annotations

import functools
import itertools
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, ChunkIndex, DataEnd, Header, McapRecord, Statistics
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agv_analysis.bags import read_bag
from benchmarks.comparison import Comparison

SAMPLE = Path(__file__).parent.parent / "bags" / "sample"
MESSAGES = 10_000_000
POSES = 300_000
OF_SLOW_PEERS = 100_000
OF_CHECK = 20_000
LOOP = ["/agv/pose", "/edge/pose", "/edge/slot", "/edge/error", "/edge/cmd_vel", "/agv/cmd_vel", "/agv/slot", "/clock"]
ANALYSED = ["/agv/pose", "/edge/slot", "/edge/error", "/edge/cmd_vel"]
SECONDS_PER_CHUNK = 4
MAGIC = b"\x89MCAP0\r\n"
UNIT = "messages/s"


def measure() -> list[Comparison]:
    """Our reader against its peers on ten million messages, and on the topics alone that an analysis asks for."""
    with tempfile.TemporaryDirectory(prefix="agv_ncs_") as folder:
        path = Path(folder) / "bag.mcap"
        total = make_bag(path, MESSAGES)
        check(path)
        counts = {topic: about.count for topic, about in read_bag(path, ()).topics.items()}
        some = sum(counts[topic] for topic in ANALYSED)
        megabytes = inflated(path) / 1e6
        whole, part = (_best(functools.partial(read_bag, path, topics)) for topics in (LOOP, ANALYSED))
        alone, kept = _best(lambda: inflated(path)), _best(lambda: list(inflate(path)))
        support = _rate_of(iterate_support(path, LOOP))
        rosbags = _rate_of(iterate_rosbags(path, LOOP))
        bare = _rate_of(iterate_mcap(path, LOOP))
        export, loop = _processes(Path(folder))
    all_topics, inflating = f"{total / 1e6:.1f} million messages, all topics", "decompression alone"
    return [
        Comparison(all_topics, total / whole.wall, "mcap-ros2-support, decoded", support, UNIT, 100.0),
        Comparison(all_topics, total / whole.wall, "rosbags, decoded", rosbags, UNIT, 50.0),
        Comparison(all_topics, total / whole.wall, "mcap, not decoded", bare, UNIT),
        Comparison("all topics", megabytes / whole.wall, inflating, megabytes / alone.wall, "MB/s", 1 / 3),
        Comparison(
            f"the {some / 1e6:.1f} million of an analysis", megabytes / part.wall, inflating, megabytes / alone.wall,
            "MB/s", 1 / 3,
        ),
        Comparison("all topics", megabytes / whole.wall, f"{inflating}, kept", megabytes / kept.wall, "MB/s"),
        Comparison(
            "export of 300 000 poses to NPZ, whole process", POSES / export, "mcap-ros2-support, plain loop",
            POSES / loop, UNIT, 8.0,
        ),
        Comparison("all topics, time of all cores", megabytes / whole.cpu, inflating, megabytes / alone.cpu, "MB/s"),
    ]  # fmt: skip


class Seconds(NamedTuple):
    """How long something takes, by the wall's clock and on all cores together."""

    wall: float
    cpu: float


def _best(work: Callable[[], object], times: int = 8) -> Seconds:
    """Best of some tries: the machine's own noise only ever adds time.

    Much of that noise is memory: a virtual machine whose host takes back what is free may get it again at half a
    gigabyte a second, twenty times as slowly as one that has it.
    """
    found = []
    for _ in range(times):
        begun, begun_cpu = time.perf_counter(), time.process_time()
        work()
        found.append(Seconds(time.perf_counter() - begun, time.process_time() - begun_cpu))
    return Seconds(min(wall for wall, _ in found), min(cpu for _, cpu in found))


PLAIN_LOOP = """
import sys
from mcap.reader import NonSeekingReader
from mcap_ros2.decoder import DecoderFactory
with open(sys.argv[1], "rb") as file:
    for _ in NonSeekingReader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(log_time_order=False):
        pass
"""


def _processes(folder: Path) -> tuple[float, float]:
    """Seconds that an export of poses takes, and a loop over the decoded messages, each as a whole process."""
    path, out = folder / "poses.mcap", folder / "poses.npz"
    make_bag(path, POSES, ["/agv/pose"])

    def export() -> None:
        out.unlink(missing_ok=True)
        command = [sys.executable, "-m", "agv_analysis.cli", "bag", "export", str(path), "--npz", "--out", str(out)]
        subprocess.run(command, check=True, capture_output=True)

    def loop() -> None:
        subprocess.run([sys.executable, "-c", PLAIN_LOOP, path], check=True)

    return _best(export, times=4).wall, _best(loop, times=1).wall


def _rate_of(messages: Iterable[object]) -> float:
    begun = time.perf_counter()
    count = sum(1 for _ in itertools.islice(messages, OF_SLOW_PEERS))
    return count / (time.perf_counter() - begun)


# -- peers ------------------------------------------------------------------------------------------------------------


def iterate_support(path: Path, topics: list[str]) -> Iterable[Any]:
    """(schema, channel, record, message) by mcap-ros2-support."""
    with path.open("rb") as file:  # the seeking reader, which orders messages, is slower
        reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
        yield from reader.iter_decoded_messages(topics=topics, log_time_order=False)


def iterate_mcap(path: Path, topics: list[str]) -> Iterable[Any]:
    """(schema, channel, record) by the mcap library."""
    with path.open("rb") as file:
        yield from NonSeekingReader(file).iter_messages(topics=topics, log_time_order=False)


def iterate_rosbags(path: Path, topics: list[str]) -> Iterable[Any]:
    """(topic, time, message) by rosbags."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        for connection in connections:
            if connection.msgtype not in store.types:
                store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, ns, data in reader.messages(connections):
            yield connection.topic, ns, store.deserialize_cdr(data, connection.msgtype)


def inflate(path: Path) -> Iterator[bytes]:
    """All chunks, read and inflated, and nothing else is done."""
    decompressor = zstandard.ZstdDecompressor()
    with path.open("rb") as file:
        file.seek(8)
        while head := file.read(9):
            opcode, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
            if opcode == Opcode.CHUNK:
                yield decompressor.decompress(memoryview(file.read(length))[44:])
            else:
                file.seek(length, 1)


def inflated(path: Path) -> int:
    """Bytes of all chunks when inflated."""
    return sum(map(len, inflate(path)))


def check(path: Path) -> None:
    """See that we read the same numbers as mcap-ros2-support, to the last bit, in the first messages."""
    bag = read_bag(path, LOOP)
    rows = dict.fromkeys(LOOP, 0)
    for _, channel, _, message in itertools.islice(iterate_support(path, LOOP), OF_CHECK):
        row = bag[channel.topic][rows[channel.topic]]
        rows[channel.topic] += 1
        for column in row.dtype.names or ():
            if not column.endswith("_ns"):
                value = functools.reduce(getattr, column.split("."), message)
                expected = value.encode() if isinstance(value, str) else value
                kind = row.dtype[column].base
                if np.asarray(expected, kind).tobytes() != np.asarray(row[column], kind).tobytes():
                    raise RuntimeError(f"{channel.topic}: {column} is {row[column]!r}, not {expected!r}")


# -- the bag ----------------------------------------------------------------------------------------------------------


class Template(NamedTuple):
    """One chunk of the sample, and where in it the stamps are."""

    content: bytes
    times: NDArray[np.int64]
    """Places of all log and publish times."""
    seconds: NDArray[np.int64]
    """Places of the seconds of all messages' own stamps."""
    entries: dict[int, NDArray[np.uint64]]
    """(log time, place) of the messages by channel, as in a message index."""
    definitions: list[McapRecord]
    """Schemas and channels."""


def make_bag(path: Path, messages: int, topics: Sequence[str] = LOOP) -> int:
    """Write an MCAP file as the recorder does, of at least `messages` messages; returns their number."""
    template = _template(topics)
    per_chunk = sum(map(len, template.entries.values()))
    chunks = -(-messages // per_chunk)
    with path.open("wb") as file:
        file.write(MAGIC + _bytes(Header("ros2", "agv_ncs"), *template.definitions))
        places = [_write_chunk(file, template, number) for number in range(chunks)]
        file.write(_bytes(DataEnd(0)))
        begin = file.tell()
        counts = {channel: chunks * len(entries) for channel, entries in template.entries.items()}
        statistics = Statistics(
            attachment_count=0, channel_count=len(counts), channel_message_counts=counts, chunk_count=chunks,
            message_count=sum(counts.values()), message_end_time=places[-1].message_end_time,
            message_start_time=places[0].message_start_time, metadata_count=0, schema_count=len(counts),
        )  # fmt: skip
        summary = _bytes(*template.definitions, statistics, *places)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, 0)
        file.write(summary + head + struct.pack("<I", zlib.crc32(summary + head)) + MAGIC)
    return chunks * per_chunk


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _template(topics: Sequence[str]) -> Template:
    """The first steps of the sample's loop, without its diagnostics, as one chunk."""
    content, times, seconds = RecordBuilder(), [], []
    definitions: dict[str, McapRecord] = {}
    index: dict[int, list[tuple[int, int]]] = {}
    with next(SAMPLE.glob("*.mcap")).open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=topics):
            if message.log_time >= 1_000_000_000 + SECONDS_PER_CHUNK * 1_000_000_000 or schema is None:
                break
            definitions[f"1 {schema.id}"], definitions[f"2 {channel.id}"] = schema, channel
            place = content.count
            index.setdefault(channel.id, []).append((message.log_time, place))
            times += [place + 15, place + 23]
            seconds.append(place + 35)
            message.write(content)
    by_channel = {channel: np.array(entries, np.uint64) for channel, entries in index.items()}
    ordered = [definitions[key] for key in sorted(definitions)]
    packed = bytes(content.end())  # type: ignore[no-untyped-call]
    return Template(packed, np.array(times), np.array(seconds), by_channel, ordered)


def _write_chunk(file: BinaryIO, template: Template, number: int) -> ChunkIndex:
    """Write the template, its stamps moved on, with its message indexes."""
    shift = number * SECONDS_PER_CHUNK
    content = np.frombuffer(template.content, np.uint8).copy()
    _add(content, template.times, "<i8", shift * 1_000_000_000)
    _add(content, template.seconds, "<i4", shift)
    first = 1_000_000_000 * (1 + shift)
    last = first + SECONDS_PER_CHUNK * 1_000_000_000
    packed, begin = zstandard.ZstdCompressor().compress(content.data), file.tell()
    file.write(_bytes(Chunk("zstd", packed, last, first, zlib.crc32(content.data), len(content))))
    length, places = file.tell() - begin, {}
    for channel, entries in template.entries.items():
        places[channel] = file.tell()
        moved = entries + np.array([shift * 1_000_000_000, 0], np.uint64)
        head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + moved.nbytes, channel, moved.nbytes)
        file.write(head + moved.tobytes())
    return ChunkIndex(
        chunk_length=length, chunk_start_offset=begin, compression="zstd", compressed_size=len(packed),
        message_end_time=last, message_index_length=file.tell() - begin - length, message_index_offsets=places,
        message_start_time=first, uncompressed_size=len(content),
    )  # fmt: skip


def _add(content: NDArray[np.uint8], places: NDArray[np.int64], code: str, amount: int) -> None:
    """Add to the numbers at some places of a buffer."""
    size = np.dtype(code).itemsize
    bytes_of = places[:, None] + np.arange(size)
    content[bytes_of] = (content[bytes_of].view(code) + np.array(amount, code)).view(np.uint8)
