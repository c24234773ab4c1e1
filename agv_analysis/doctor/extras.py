"""What of this package's extras is installed."""

from __future__ import annotations

from importlib import metadata
from typing import Any

from packaging.requirements import Requirement

PACKAGE = "agv_ncs"


def requirements() -> dict[str, list[Requirement]]:
    """What each extra needs, by the metadata of the installed package; under "" what is always needed.

    Empty where the package runs from its sources alone.
    """
    try:
        about = metadata.metadata(PACKAGE)
    except metadata.PackageNotFoundError:
        return {}
    needed = [Requirement(line) for line in about.get_all("Requires-Dist") or []]
    extras = sorted(about.get_all("Provides-Extra") or [])
    always = [one for one in needed if one.marker is None or one.marker.evaluate({"extra": ""})]
    return {"": always} | {
        extra: [one for one in needed if one not in always and one.marker and one.marker.evaluate({"extra": extra})]
        for extra in extras
    }


def extra_with(name: str) -> str | None:
    """The extra that brings a package, None if none does: the narrowest, so neither `all` nor `test`."""
    brings = {
        extra: len(packages) for extra, packages in requirements().items() if name in {one.name for one in packages}
    }
    return min((extra for extra in brings if extra), key=lambda extra: brings[extra], default=None)


def installed(needed: list[Requirement]) -> dict[str, Any]:
    """Versions of the packages that are there, and what is missing or too old, as pip would be asked for it."""
    versions = {one.name: version_of(one.name) for one in needed}
    missing = [
        f"{one.name}{one.specifier}"
        for one in needed
        if versions[one.name] is None or not one.specifier.contains(str(versions[one.name]), prereleases=True)
    ]
    return {"versions": versions, "missing": missing}


def version_of(name: str) -> str | None:
    """Version of an installed package, None if it is not there."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
