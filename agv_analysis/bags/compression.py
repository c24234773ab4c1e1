"""Inflating the chunks of a bag, never beyond what they declare."""

from __future__ import annotations

from collections.abc import Callable

from agv_analysis.bags.errors import DamagedError

MAX_CHUNK = 2**30
"""Most bytes [B] that one chunk may inflate to: a thousand times what ROS 2 writes."""


def inflate(compression: str, content: bytes, size: int) -> bytes:
    """Content of a chunk that declares to have `size` bytes; the result may be shorter, never longer.

    Raises DamagedError if the content is not what it is said to be, or if the size is beyond MAX_CHUNK.
    """
    if size > MAX_CHUNK:
        raise DamagedError(f"{size} bytes declared, at most {MAX_CHUNK} are inflated")
    if compression not in _INFLATE:
        raise DamagedError(f"compression {compression[:20]!r}, known are {', '.join(filter(None, _INFLATE))}")
    return _INFLATE[compression](content, size)


def _copy(content: bytes, size: int) -> bytes:
    if len(content) > size:
        raise DamagedError(f"{len(content)} bytes where {size} are declared")
    return content


def _zstd(content: bytes, size: int) -> bytes:
    import zstandard

    try:
        frame = zstandard.get_frame_parameters(content)
        if frame.content_size == size and size:
            return zstandard.ZstdDecompressor(max_window_size=0).decompress(content)
        # A frame of unknown or other length: read on, but not beyond what is declared.
        with zstandard.ZstdDecompressor().stream_reader(content) as reader:
            return _at_most(reader.read, size)
    except zstandard.ZstdError as error:
        raise DamagedError(f"zstd: {error}") from None


def _lz4(content: bytes, size: int) -> bytes:
    import lz4.frame

    frame, pending = lz4.frame.LZ4FrameDecompressor(), [content]

    def read(limit: int) -> bytes:
        return b"" if frame.eof else bytes(frame.decompress(pending.pop() if pending else b"", limit))

    try:
        return _at_most(read, size)
    except (RuntimeError, EOFError) as error:
        raise DamagedError(f"lz4: {error}") from None


def _at_most(read: Callable[[int], bytes], size: int) -> bytes:
    """All that there is to read; raises DamagedError if it is more than `size` bytes."""
    parts, left = [], size + 1
    while left:
        part = read(left)
        if not part:
            break
        parts.append(part)
        left -= len(part)
    if not left:
        raise DamagedError(f"more than the {size} bytes that are declared")
    return b"".join(parts)


_INFLATE: dict[str, Callable[[bytes, int], bytes]] = {"": _copy, "zstd": _zstd, "lz4": _lz4}
