"""A channel without losses."""

from __future__ import annotations


def perfect() -> bool:
    """Never lost."""
    return False
