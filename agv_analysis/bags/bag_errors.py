"""What can be wrong with a bag."""

from __future__ import annotations

from agv_ros.errors import UserError


class BagError(UserError):
    """A bag that cannot be used; the text names the file, what is wrong with it and, where there is one, the remedy."""


class DamagedError(ValueError):
    """Bytes that are not the expected record; never leaves this package."""


class UndecodableError(ValueError):
    """A type whose messages cannot become arrays, or a message that is not of its type; the text says why."""


class PaddingError(UndecodableError):
    """Messages that differ so much in length that an array of them would be out of all proportion."""
