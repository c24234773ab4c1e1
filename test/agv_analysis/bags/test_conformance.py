"""All files of the kinds in MCAP's conformance suite, written from its description: plain, and with bytes added.

Source: https://mcap.dev/spec and the suite's list of features. A file has one of six contents and any set of
features that makes sense for it; `pad` adds three bytes behind the last field of each record that may grow.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from agv_analysis.bags import read_bag
from agv_analysis.bags.mcap_file import McapFile
from agv_analysis.bags.recover import recover

MAGIC = b"\x89MCAP0\r\n"
PAD = b"\x01\xff\xff"
SCHEMA = ("Example", "c", b"\4\5\6")
CHANNEL = ("example", "a", {"foo": "bar"})
TEN = [0, 2, 1, 3, 3, 5, 4, 7, 8, 9]


class Content(NamedTuple):
    schema: tuple[str, str, bytes] | None = None
    channel: tuple[str, str, dict[str, str]] | None = None
    messages: tuple[tuple[int, int, bytes], ...] = ()
    """Log time, publish time, payload."""
    attachment: tuple[str, str, int, int, bytes] | None = None
    metadata: tuple[str, dict[str, str]] | None = None


CONTENTS = {
    "NoData": Content(),
    "OneSchemalessMessage": Content(None, ("example", "text", {}), ((2, 1, b"\1\2\3"),)),
    "OneMessage": Content(SCHEMA, CHANNEL, ((2, 1, b"\1\2\3"),)),
    "OneAttachment": Content(attachment=("myFile", "application/octet-stream", 2, 1, b"\1\2\3")),
    "OneMetadata": Content(metadata=("myMetadata", {"foo": "bar"})),
    "TenMessages": Content(SCHEMA, CHANNEL, tuple((time, time, b"\1\2\3") for time in TEN)),
}
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")


def makes_sense(content: Content, features: frozenset[str]) -> bool:
    indexed = {"chx", "mx"} & features
    return not (
        ("ax" in features and content.attachment is None)
        or ("mdx" in features and content.metadata is None)
        or ("rsh" in features and content.schema is None)
        or ("rch" in features and content.channel is None)
        or (content.channel is None and ("ch" in features or indexed))
        or (indexed and "ch" not in features)
        or ("sum" in features and not {"chx", "rsh", "rch", "mdx", "ax", "st"} & features)
    )


def variants() -> Iterator[tuple[str, Content, frozenset[str]]]:
    for name, content in CONTENTS.items():
        for number in range(len(FEATURES) + 1):
            for chosen in itertools.combinations(FEATURES, number):
                if makes_sense(content, frozenset(chosen)):
                    yield "-".join([name, *sorted(chosen)]), content, frozenset(chosen)


def text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def texts(values: dict[str, str]) -> bytes:
    return text(b"".join(text(key) + text(value) for key, value in values.items()))


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def generate(content: Content, features: frozenset[str], tail: bytes = PAD) -> bytes:
    """A file; `tail` is what is added to records if they are padded."""
    pad = tail if "pad" in features else b""
    data = MAGIC + record(1, text("") + text("") + pad)
    definitions = [b"", b""]
    if content.schema is not None:
        name, encoding, body = content.schema
        definitions[0] = record(3, struct.pack("<H", 1) + text(name) + text(encoding) + text(body) + pad)
    if content.channel is not None:
        topic, encoding, about = content.channel
        head = struct.pack("<HH", 1, content.schema is not None)
        definitions[1] = record(4, head + text(topic) + text(encoding) + texts(about) + pad)
    inner = b"".join(definitions)
    places = []
    for sequence, (log_time, publish_time, payload) in enumerate(content.messages):
        places.append((log_time, len(inner)))
        inner += record(5, struct.pack("<HIQQ", 1, sequence, log_time, publish_time) + payload)
    indexes: dict[str, bytes] = {}
    if "ch" in features:
        times = [time for time, _, _ in content.messages]
        begin, start = len(data), struct.pack("<QQ", min(times), max(times))
        data += record(6, start + struct.pack("<QI", len(inner), 0) + text("") + struct.pack("<Q", len(inner)) + inner)
        end, index = len(data), b""
        if "mx" in features:
            entries = b"".join(struct.pack("<QQ", time, place) for time, place in sorted(places))
            index = record(7, struct.pack("<H", 1) + text(entries) + pad)
        offsets = text(struct.pack("<HQ", 1, end) if index else b"")
        sizes = struct.pack("<QQ", len(inner), len(inner))
        about_chunk = (
            struct.pack("<QQ", begin, end - begin) + offsets + struct.pack("<Q", len(index)) + text("") + sizes
        )
        data += index
        if "chx" in features:
            indexes["chx"] = record(8, start + about_chunk + pad)
    else:
        data += inner
    if content.attachment is not None:
        name, media, log_time, create_time, body = content.attachment
        body_record = struct.pack("<QQ", log_time, create_time) + text(name) + text(media)
        body_record += struct.pack("<Q", len(body)) + body
        whole = record(9, body_record + struct.pack("<I", zlib.crc32(body_record)) + pad)
        if "ax" in features:
            about_file = struct.pack("<QQQQQ", len(data), len(whole), log_time, create_time, len(body))
            indexes["ax"] = record(10, about_file + text(name) + text(media) + pad)
        data += whole
    if content.metadata is not None:
        whole = record(12, text(content.metadata[0]) + texts(content.metadata[1]) + pad)
        if "mdx" in features:
            indexes["mdx"] = record(13, struct.pack("<QQ", len(data), len(whole)) + text(content.metadata[0]) + pad)
        data += whole
    return data + record(15, bytes(4)) + summary(content, features, definitions, indexes, len(data) + 13, pad)


def summary(
    content: Content,
    features: frozenset[str],
    definitions: list[bytes],
    indexes: dict[str, bytes],
    begin: int,
    pad: bytes,
) -> bytes:
    """Everything behind the data section, which ends at `begin`."""
    count = len(content.messages)
    numbers = (count, content.schema is not None, content.channel is not None, content.attachment is not None,
               content.metadata is not None, "ch" in features)  # fmt: skip
    times = [time for time, _, _ in content.messages] or [0]
    by_channel = text(struct.pack("<HQ", 1, count) if count else b"")
    statistics = struct.pack("<QHIIIIQQ", *numbers, min(times), max(times)) + by_channel
    groups = [
        (3, definitions[0] if "rsh" in features else b""), (4, definitions[1] if "rch" in features else b""),
        (11, record(11, statistics + pad) if "st" in features else b""), (13, indexes.get("mdx", b"")),
        (10, indexes.get("ax", b"")), (8, indexes.get("chx", b"")),
    ]  # fmt: skip
    body, offsets = b"", b""
    for opcode, group in groups:
        if group:
            offsets += record(14, struct.pack("<BQQ", opcode, begin + len(body), len(group)) + pad)
        body += group
    has_offsets = "sum" in features
    places = (begin if body else 0, begin + len(body) if has_offsets else 0)
    return body + (offsets if has_offsets else b"") + record(2, struct.pack("<QQI", *places, 0)) + MAGIC


def read_by_mcap(data: bytes) -> tuple[list[Any], ...]:
    """Messages, schemas, channels, attachments and metadata, by the library mcap."""
    found = list(StreamReader(BytesIO(data), validate_crcs=True).records)
    kinds = (Message, Schema, Channel, Attachment, Metadata)
    return tuple([item for item in found if isinstance(item, kind)] for kind in kinds)


def read_by_us(path: Path) -> tuple[McapFile, list[tuple[int, int, bytes]]]:
    file = McapFile(path, keep_all=True)
    messages = [
        found
        for _, batch in file.batches(lambda channel: True)
        for found in zip(batch.log_times.tolist(), batch.publish_times.tolist(), batch.payloads(), strict=True)
    ]
    file.close()
    return file, messages


ALL = list(variants())


def test_there_are_as_many_variants_as_in_the_suite() -> None:
    assert len(ALL) == 416
    assert sum("pad" in features for _, _, features in ALL) == 208


@pytest.mark.parametrize("name", CONTENTS)
def test_each_variant_is_read_as_the_library_reads_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.mcap"
    for variant, content, features in ALL:
        if not variant.startswith(f"{name}-") and variant != name:
            continue
        data = generate(content, features)
        path.write_bytes(data)
        file, messages = read_by_us(path)
        # The library does not step over the bytes added within chunks; the same file without them holds the same.
        plain = generate(content, features - {"pad"}) if {"pad", "ch"} <= features else data
        theirs, schemas, channels, attachments, metadata = read_by_mcap(plain)
        assert messages == list(content.messages), variant
        assert messages == [(m.log_time, m.publish_time, m.data) for m in theirs], variant
        assert [(s.name, s.encoding, s.data) for s in file.schemas.values()] == [
            (s.name, s.encoding, s.data) for s in schemas[:1]
        ], variant
        assert [(c.topic, c.encoding, c.metadata) for c in file.channels.values()] == [
            (c.topic, c.message_encoding, c.metadata) for c in channels[:1]
        ], variant
        assert [(*a[:4], a.content) for a in file.attachments] == [
            (a.name, a.media_type, a.log_time, a.create_time, a.data) for a in attachments
        ], variant
        assert file.metadata == [(m.name, m.metadata) for m in metadata], variant
        assert not file.findings.is_loss, (variant, file.findings.texts())
        assert (file.statistics is not None) == ("st" in features), variant
        if file.statistics is not None:
            assert file.statistics.messages == len(content.messages)


EXTRA = {
    "more than a record head": bytes(40),
    "like a record's head": struct.pack("<BQ", 5, 2**40),
    "one byte": b"\0",
}


@pytest.mark.parametrize("tail", EXTRA)
def test_whatever_a_newer_version_adds_is_ignored(tmp_path: Path, tail: str) -> None:
    content = CONTENTS["TenMessages"]._replace(
        attachment=CONTENTS["OneAttachment"].attachment, metadata=CONTENTS["OneMetadata"].metadata
    )
    for features in (frozenset(FEATURES), frozenset(FEATURES) - {"ch", "chx", "mx"}, frozenset({"pad"})):
        (tmp_path / "a.mcap").write_bytes(generate(content, features, EXTRA[tail]))
        file, messages = read_by_us(tmp_path / "a.mcap")
        assert messages == list(content.messages)
        assert len(file.attachments) == len(file.metadata) == 1
        assert not file.findings.is_loss, file.findings.texts()


@pytest.mark.parametrize("opcode", [0x10, 0x7F, 0x80, 0xFF])
def test_records_of_unknown_kinds_are_passed_over(tmp_path: Path, opcode: int) -> None:
    """Wherever they are, and if there are several of them."""
    content, unknown = CONTENTS["TenMessages"], record(opcode, b"\5" + bytes(30)) * 3
    for features in (frozenset({"ch", "st"}), frozenset({"st"}), frozenset({"ch", "mx", "st", "rch"})):
        data, position, parts = generate(content, features), 8, [MAGIC]
        while position < len(data) - 8:
            kind, length = struct.unpack_from("<BQ", data, position)
            whole = data[position : position + 9 + length]
            if kind == 6:
                inner = whole[9 + 40 :] + unknown
                head = whole[9:25] + struct.pack("<QI", len(inner), 0) + text("") + struct.pack("<Q", len(inner))
                whole = record(6, head + inner)
            if kind == 2:
                whole = record(2, bytes(20))
            parts.append(whole + (unknown if kind != 2 else b""))
            position += 9 + length
        (tmp_path / "a.mcap").write_bytes(b"".join([*parts, MAGIC]))
        file, messages = read_by_us(tmp_path / "a.mcap")
        assert messages == list(content.messages)
        assert not file.findings.is_loss, file.findings.texts()
        said = f"record of the {'private' if opcode >= 128 else 'unknown'} kind {opcode}, passed over"
        assert any(problem.startswith(said) for problem in read_bag(tmp_path / "a.mcap").problems)


@pytest.mark.parametrize("number", range(0, 416, 23))
def test_recovered_files_hold_all_of_it(tmp_path: Path, number: int) -> None:
    _, content, features = ALL[number]
    (tmp_path / "a.mcap").write_bytes(generate(content, features))
    recovery = recover(tmp_path / "a.mcap", tmp_path / "out.mcap")
    assert recovery.is_complete
    messages, _, _, attachments, metadata = read_by_mcap((tmp_path / "out.mcap").read_bytes())
    assert [(m.log_time, m.publish_time, m.data) for m in messages] == list(content.messages)
    assert [a.data for a in attachments] == ([] if content.attachment is None else [content.attachment[4]])
    assert [(m.name, m.metadata) for m in metadata] == ([] if content.metadata is None else [content.metadata])


def _footer(data: bytes) -> bytes:
    return data[:-37] + record(2, data[-28:-8] + PAD) + MAGIC


def _data_end(data: bytes) -> bytes:
    at = data.index(record(15, bytes(4)))
    crc = struct.pack("<I", zlib.crc32(data[:at]))
    return data[:at] + record(15, crc + PAD) + record(2, bytes(20)) + MAGIC


def _chunk(data: bytes) -> bytes:
    position, kind, length = 8, 0, 0
    while True:
        kind, length = struct.unpack_from("<BQ", data, position)
        if kind == 6:
            content = data[position + 9 : position + 9 + length]
            return data[:position] + record(6, content + PAD) + record(15, bytes(4)) + record(2, bytes(20)) + MAGIC
        position += 9 + length


@pytest.mark.parametrize("change", [_footer, _data_end, _chunk])
def test_records_that_nobody_extends_today_may_be_extended_too(
    tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    content = CONTENTS["TenMessages"]
    (tmp_path / "a.mcap").write_bytes(change(generate(content, frozenset({"ch", "rsh", "rch"}))))
    file, messages = read_by_us(tmp_path / "a.mcap")
    assert messages == list(content.messages)
    assert not file.findings.is_loss, file.findings.texts()
