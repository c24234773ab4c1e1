"""What source archive and wheel hold: what must be there, what must not, and archives of equal bytes."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from pathlib import Path

NOT_INSIDE = ("test/", "bags/", "benchmarks/", "fuzz/", "torture/", "release/", ".ci/", ".git", ".venv")
"""How paths begin that are for those who work on the project."""

NEVER = (".mcap", ".db3", ".pyc", ".so", ".stamp")
"""Endings of what is data, or made on one machine."""

OF_THE_WHEEL = (
    "agv_ncs/__init__.py", "agv_ncs/py.typed", "agv_analysis/cli.py", "agv_analysis/report/report.html.j2",
    "share/agv_ncs/package.xml", "share/agv_ncs/config/paper.yaml", "share/agv_ncs/launch/loop.launch.py",
    "share/ament_index/resource_index/packages/agv_ncs", "entry_points.txt", "LICENSE",
)  # fmt: skip
OF_THE_SOURCES = (
    "setup.py", "setup.cfg", "pyproject.toml", "package.xml", "README.md", "LICENSE", "CHANGELOG.md", "PKG-INFO",
    "resource/agv_ncs", "config/outages.yaml", "launch/loop.launch.py", "agv_plant/plant_node.py",
)  # fmt: skip


def names_in(archive: Path) -> list[str]:
    """Paths of the files in an archive; those of a source archive without its folder."""
    if archive.suffix == ".whl":
        return sorted(name for name in zipfile.ZipFile(archive).namelist() if not name.endswith("/"))
    with tarfile.open(archive) as sources:
        return sorted(member.name.partition("/")[2] for member in sources if member.isfile())


def complaints(archive: Path) -> list[str]:
    """What is wrong with the contents of an archive, a line each."""
    names = names_in(archive)
    wanted = OF_THE_WHEEL if archive.suffix == ".whl" else OF_THE_SOURCES
    absent = [name for name in wanted if not any(f"/{one}".endswith(f"/{name}") for one in names)]
    strange = [name for name in names if name.startswith(NOT_INSIDE) or name.endswith(NEVER)]
    lines = [f"{name} must not be inside" for name in strange] + [f"{name} is missing" for name in absent]
    return [f"{archive.name}: {line}" for line in lines]


def same_each_time(archive: Path, epoch: int) -> None:
    """Write a source archive anew, sorted, of no user, of the instant `epoch` [s]: setuptools leaves that to others."""
    made = io.BytesIO()
    with tarfile.open(archive) as found, tarfile.open(fileobj=made, mode="w", format=tarfile.PAX_FORMAT) as sources:
        for member in sorted(found, key=lambda one: one.name):
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mtime, member.pax_headers = epoch, {}
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            sources.addfile(member, found.extractfile(member) if member.isfile() else None)
    archive.write_bytes(gzip.compress(made.getvalue(), mtime=epoch))
