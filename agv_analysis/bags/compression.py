"""Inflating the chunks of a bag, never beyond a given size."""

from __future__ import annotations

import threading
from collections.abc import Callable

from agv_analysis.bags.bag_errors import DamagedError

MAX_CHUNK = 2**30
"""Most bytes that one chunk may inflate to: a thousand times what ROS 2 writes."""

_PIECE = 2**22
"""Bytes that are inflated at a time where the total is unknown."""

NAMES = ("", "zstd", "lz4")
"""Compressions of the MCAP registry."""

_OF_THREAD = threading.local()
"""A decompressor for each thread: to make one takes a tenth of the time that a chunk does."""

MAGICS = {"zstd": b"\x28\xb5\x2f\xfd", "lz4": b"\x04\x22\x4d\x18"}
"""First bytes of compressed content."""


def inflate(compression: str, content: bytes, size: int) -> bytes:
    """Content of a chunk that declares to have `size` bytes; the result may be shorter, never longer.

    Raises DamagedError if the content is not what it is said to be, if there is more of it, or if the size is beyond
    MAX_CHUNK.
    """
    if size > MAX_CHUNK:
        raise DamagedError(f"{size} bytes are declared, at most {MAX_CHUNK} are inflated")
    if compression not in NAMES:
        raise DamagedError(f"compression {compression[:20]!r} is not known; known are zstd, lz4 and none")
    if not content and not size:
        return b""
    if compression == "zstd" and _zstd_size(content) == size:
        return _whole_zstd(content)
    inflated = inflate_start(compression, content, size + 1)
    if len(inflated) > size:
        raise DamagedError(f"it holds more than the {size} bytes that are declared")
    return inflated


def inflate_start(compression: str, content: bytes, limit: int) -> bytes:
    """As much of a content as can be inflated, `limit` bytes at most: all of it, or what a cut has left.

    Raises DamagedError if the content is not what it is said to be.
    """
    if not compression:
        return content[:limit]
    read, error = _READERS[compression](content)
    parts = []
    try:
        while limit > 0 and (part := read(min(limit, _PIECE))):
            parts.append(part)
            limit -= len(part)
    except error as problem:
        raise DamagedError(f"{compression}: {problem}") from None
    return b"".join(parts)


def declared_size(compression: str, content: bytes) -> int | None:
    """Size that compressed content itself declares, None if it does not. Raises DamagedError if it is none."""
    if compression == "zstd":
        return _zstd_size(content)
    return _lz4_size(content) if compression == "lz4" else None


def _zstd_size(content: bytes) -> int | None:
    import zstandard

    try:
        size = zstandard.get_frame_parameters(content).content_size
    except zstandard.ZstdError as error:
        raise DamagedError(f"zstd: {error}") from None
    return None if size == zstandard.CONTENTSIZE_UNKNOWN else int(size)


def _lz4_size(content: bytes) -> int | None:
    import lz4.frame

    try:
        return lz4.frame.get_frame_info(content)["content_size"] or None
    except RuntimeError as error:
        raise DamagedError(f"lz4: {error}") from None


def compression_of(content: bytes) -> str:
    """Compression by what the content begins with."""
    return next((name for name, magic in MAGICS.items() if content.startswith(magic)), "")


def _whole_zstd(content: bytes) -> bytes:
    """In one go, which is the fastest; what it allocates is the frame's own declaration, checked before."""
    import zstandard

    if not hasattr(_OF_THREAD, "decompressor"):
        _OF_THREAD.decompressor = zstandard.ZstdDecompressor()
    try:
        return bytes(_OF_THREAD.decompressor.decompress(content))
    except zstandard.ZstdError as error:
        raise DamagedError(f"zstd: {error}") from None


_Reader = tuple[Callable[[int], bytes], type[Exception]]


def _zstd(content: bytes) -> _Reader:
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(content, read_across_frames=True).read, zstandard.ZstdError


def _lz4(content: bytes) -> _Reader:
    import lz4.frame

    frame, pending = lz4.frame.LZ4FrameDecompressor(), [content]

    def read(limit: int) -> bytes:
        return b"" if frame.eof else bytes(frame.decompress(pending.pop() if pending else b"", limit))

    return read, RuntimeError


_READERS: dict[str, Callable[[bytes], _Reader]] = {"zstd": _zstd, "lz4": _lz4}
