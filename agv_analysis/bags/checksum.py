"""The CRC-32 that MCAP uses, by the fastest library that is installed."""

from __future__ import annotations

try:  # several times as fast, and a bag's bytes all go through it
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
