"""Files that were compressed as a whole, by rosbag2 (zstd) or by hand, and archives, by their first bytes."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from agv_analysis.bags.bag_errors import BagError, DamagedError
from agv_analysis.bags.compression import MAGICS, declared_size

_MOST_TIMES = 1000
_ALWAYS_UNPACKED = 2**30
"""A file may decompress to this many times its size, or to this many bytes."""

_PIECE = 2**22

_HEADER = 18
"""First bytes of a file that say how it is compressed and, in zstd, the size of what was."""

_TAR_MAGIC, _TAR_MAGIC_AT = b"ustar", 257


def _zstd(file: BinaryIO) -> Callable[[int], bytes]:
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True).read


def _lz4(file: BinaryIO) -> Callable[[int], bytes]:
    import lz4.frame

    reader: Callable[[int], bytes] = lz4.frame.LZ4FrameFile(file).read1
    return reader


def _gzip(file: BinaryIO) -> Callable[[int], bytes]:
    return gzip.GzipFile(fileobj=file).read1


def _xz(file: BinaryIO) -> Callable[[int], bytes]:
    return lzma.LZMAFile(file).read1


def _bzip2(file: BinaryIO) -> Callable[[int], bytes]:
    return bz2.BZ2File(file).read1


_READERS = {
    MAGICS["zstd"]: _zstd,
    MAGICS["lz4"]: _lz4,
    b"\x1f\x8b": _gzip,
    b"\xfd7zXZ\0": _xz,
    b"BZh": _bzip2,
}
"""First bytes of a file -> what gives a function that reads so many inflated bytes, none at the end.

It reads no further than it must: what comes before the end of a file that was cut is wanted.
"""

_ARCHIVES = {b"PK\x03\x04": "unzip", b"7z\xbc\xaf\x27\x1c": "7z x"}
"""First bytes of archives, and what unpacks them."""


def is_packed(begin: bytes) -> bool:
    """Does a file with these first bytes hold another file, compressed?"""
    return begin.startswith(tuple(_READERS))


def unpack(path: Path, target: Path) -> str:
    """Inflate a file, as far as it goes, to `target`; returns what ended that before its end, empty if nothing did.

    Raises BagError if it cannot be read or written, is an archive, or inflates to far more than any recording does.
    """
    import zstandard

    damage, written = "", 0
    try:
        most = max(_ALWAYS_UNPACKED, _MOST_TIMES * path.stat().st_size)
        with path.open("rb") as packed, target.open("xb") as file:
            begin = packed.read(_HEADER)
            packed.seek(0)
            read = next(reader for magic, reader in _READERS.items() if begin.startswith(magic))(packed)
            while written <= most and (piece := read(_PIECE)):
                if not written:
                    refuse_archive(piece, path)
                written += file.write(piece)
            if begin.startswith(MAGICS["zstd"]) and written < (declared_size("zstd", begin) or 0):
                damage = "it ends before what it declares"  # the only one whose library does not say so
    except (
        DamagedError,
        zstandard.ZstdError,
        zlib.error,
        lzma.LZMAError,
        gzip.BadGzipFile,
        EOFError,
        RuntimeError,
    ) as error:
        damage = str(error)
    except OSError as error:
        if error.errno is None:  # of bz2, whose errors have no type of their own
            damage = str(error)
        else:
            raise BagError(f"{path}: cannot be unpacked to {target.parent}: {error.strerror}") from None
    if written > most:
        raise BagError(f"{path}: inflates to more than {_MOST_TIMES} times its size, as no recording does")
    return damage


def refuse_archive(begin: bytes, path: Path) -> None:
    """Raise BagError if a file begins, once inflated, as an archive of several files does."""
    is_tar = begin[_TAR_MAGIC_AT:].startswith(_TAR_MAGIC)
    command = "tar xf" if is_tar else next((name for magic, name in _ARCHIVES.items() if begin.startswith(magic)), None)
    if command is not None:
        raise BagError(f"{path}: is an archive: `{command} {path}` unpacks it, then name the bag in it")
