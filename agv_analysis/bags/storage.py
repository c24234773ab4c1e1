"""What a bag consists of: files with messages in them, whatever their format."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from agv_analysis.bags.findings import Findings
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.records import Attachment, Channel, Foreign, Schema

LARGE = 2**28
LARGE_ONCE_LOADED = 2**24
"""Files of more bytes than this are read by compiled code: to load the compiler takes as long as to read the first
number of bytes without it."""


def is_large(size: int) -> bool:
    """Does compiled code pay for a file of so many bytes?"""
    return size > (LARGE_ONCE_LOADED if "numba" in sys.modules else LARGE)


IsWanted = Callable[[Channel], bool]


def undescribed(number: int) -> Channel:
    """A channel for messages whose own one is not described, so that their topic is not known."""
    return Channel(number, 0, f"/undescribed_channel_{number}", "", {})


class Storage(Protocol):
    """One file of a bag; everything but the batches is complete only after these have been read."""

    path: Path
    findings: Findings
    metadata: list[tuple[str, dict[str, str]]]
    """Metadata records: name and content; a name may be there more than once."""
    attachments: list[Attachment]
    """With their content if the storage was opened to keep all, else without."""
    foreign: list[Foreign]
    """Records of kinds that are not known here, if the storage was opened to keep all."""
    counts: Counter[int]
    """Messages found by channel."""
    position: int
    """How much has been read, of `size`."""

    @property
    def distro(self) -> str:
        """ROS distribution of the recorder, empty if the file does not say."""
        ...

    @property
    def size(self) -> int:
        """How much there is to read [B]."""
        ...

    @property
    def schemas(self) -> dict[int, Schema]:
        """Schemas by number."""
        ...

    @property
    def channels(self) -> dict[int, Channel]:
        """Channels by number."""
        ...

    def expected(self, channel: int) -> int:
        """Messages that the channel is said to have, 0 if nothing is said."""
        ...

    def batches(self, is_wanted: IsWanted) -> Iterator[tuple[Channel, Batch]]:
        """The messages of all channels that are wanted, in file order, in batches of one channel. To be called once."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...
