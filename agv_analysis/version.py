"""The version that results carry."""

from __future__ import annotations

from importlib import metadata


def version() -> str:
    """Version of the installed package; `not installed` where it runs from its sources alone."""
    try:
        return metadata.version("agv_ncs")
    except metadata.PackageNotFoundError:
        return "not installed"
