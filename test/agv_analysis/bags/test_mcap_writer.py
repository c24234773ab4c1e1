"""What is written, byte for byte against the library's own writer."""

from __future__ import annotations

import io
import random

import pytest
from mcap.writer import CompressionType, Writer

from agv_analysis.bags.mcap_writer import McapWriter

CHUNK = 4096


def library_writer(stream: io.BytesIO) -> Writer:
    writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True)
    writer.start(profile="ros2", library="agv_ncs 1")
    return writer


def fill(writer: Writer | McapWriter, seed: int, messages: int) -> None:
    """Schemas, channels, messages, metadata and attachments in random order, of random sizes and times."""
    draw = random.Random(seed)
    channels = []
    for number in range(3):
        schema = writer.register_schema(f"a/msg/T{number}", "ros2msg", draw.randbytes(draw.choice([0, 300])))
        channels.append(writer.register_channel(f"/topic_{number}", "cdr", schema, {"key": "value"} if number else {}))
    for count in range(messages):
        log_time = draw.choice([0, 5, count, 2**63 - 1, draw.randrange(2**62)])
        writer.add_message(draw.choice(channels), log_time, draw.randbytes(draw.choice([0, 1, 48, 5000])), count)
        if draw.random() < 0.02:
            writer.add_metadata(f"name {count}", {"a": "b" * count})
        if draw.random() < 0.02:
            writer.add_attachment(count, log_time, f"file {count}", "text/plain", draw.randbytes(count))
        if draw.random() < 0.02:
            writer.flush()
        if draw.random() < 0.02:
            channels.append(writer.register_channel(f"/late_{count}", "cdr", 1, {}))
    writer.finish()


@pytest.mark.parametrize(("seed", "messages"), [(0, 0), (1, 1), (2, 40), (3, 400), (4, 400)])
def test_a_file_is_the_one_that_the_library_writes(seed: int, messages: int) -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    fill(McapWriter(ours, CHUNK, "agv_ncs 1"), seed, messages)
    fill(library_writer(theirs), seed, messages)
    assert ours.getvalue() == theirs.getvalue()
