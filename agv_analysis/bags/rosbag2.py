"""The files of a bag: what a rosbag2 directory holds, with metadata.yaml or without.

What kind a file is its first bytes say, not its name. metadata.yaml is a hint: where it and the files differ, the files
are right, and the difference is reported.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

from agv_analysis.bags.bag_errors import BagError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.mcap_file import McapFile
from agv_analysis.bags.packed_files import is_packed, refuse_archive, unpack
from agv_analysis.bags.records import MAGIC as MCAP
from agv_analysis.bags.storage import Storage
from agv_ros.errors import refuse_irregular

METADATA = "metadata.yaml"

SQLITE = b"SQLite format 3\0"
"""First bytes of a sqlite3 database."""

_PACKED = (".zstd", ".zst", ".gz", ".lz4", ".xz", ".bz2")
"""Endings of files that were compressed as a whole; the first is rosbag2's."""

_STORAGES = (".mcap", ".db3")

_MAX_METADATA = 2**26
"""Most bytes of a metadata.yaml; that of a bag with a thousand topics and files has one million."""


class _Found(Protocol):
    """A topic as it was found in the files."""

    @property
    def type(self) -> str: ...

    @property
    def count(self) -> int: ...


@dataclass
class Contents:
    """Where the messages of a bag are, and what its metadata.yaml says of them."""

    files: list[Path]
    counts: dict[str, int] = field(default_factory=dict)
    """Messages by topic."""
    types: dict[str, str] = field(default_factory=dict)
    """Types by topic."""
    distro: str = ""
    """ROS distribution of the recorder."""
    custom_data: dict[str, str] | None = None
    """What was noted when it was recorded (`ros2 bag record --custom-data`)."""
    findings: Findings = field(default_factory=Findings)

    def compare(self, topics: Mapping[str, _Found], findings: Findings) -> None:
        """Report where metadata.yaml and the files, in which these topics were found, disagree."""
        renamed = self._renamed(topics)
        for listed, there in renamed:
            few = "topic" if len(listed) == 1 else "topics"
            findings.add(f"{', '.join(there)}: {few} that {METADATA} calls {', '.join(listed)}", len(listed))
        accounted = {topic for listed, _ in renamed for topic in listed}
        for topic, expected in self.counts.items():
            found = topics.get(topic)
            count = found.count if found else 0
            if topic in accounted:
                continue
            if count < expected:
                what = f"{topic}: message that {METADATA} counts and that is not there"
                findings.add(what, expected - count, is_loss=True)
            elif count > expected:
                findings.add(f"{topic}: message more than {METADATA} counts", count - expected)
            if found and found.type and self.types.get(topic) not in ("", found.type):
                findings.add(f"{topic}: topic of type {found.type} that {METADATA} calls {self.types.get(topic)}")

    def _renamed(self, topics: Mapping[str, _Found]) -> list[tuple[list[str], list[str]]]:
        """Topics of metadata.yaml that are not in the bag, with those of equal type and count that are not in it.

        Several that are equal in this are together: which is which is ambiguous, but none is missing.
        """
        strange = {name: found for name, found in topics.items() if name not in self.counts}
        groups: dict[tuple[str, int], list[str]] = {}
        for topic in sorted(self.counts.keys() - topics.keys()):
            groups.setdefault((self.types[topic], self.counts[topic]), []).append(topic)
        found: list[tuple[list[str], list[str]]] = []
        for (kind, count), listed in groups.items():
            there = sorted(
                name for name, other in strange.items() if (other.type or kind, other.count) == (kind, count)
            )
            if len(there) == len(listed):
                found.append((listed, there))
                strange = {name: other for name, other in strange.items() if name not in there}
        return found


def locate(path: Path) -> Contents:
    """Contents of a rosbag2 directory, of a bare file, or of the bag that a file belongs to. Raises BagError."""
    if not path.exists():
        raise BagError(f"{path}: there is no such file or directory")
    if path.is_dir():
        return _directory(path)
    if path.name == METADATA:
        return _directory(path.parent)
    return _bag_of_file(path)


def looks_like_bag(path: Path, begin: bytes) -> bool:
    """May this be a bag, by what a directory holds, or by a file's first bytes and, if it is compressed, its name?"""
    if path.is_dir():
        return (path / METADATA).exists() or bool(_files_in(path))
    is_named = Path(_unpacked_name(path.name)).suffix.lower() in _STORAGES
    return begin.startswith((MCAP[:5], SQLITE)) or (is_packed(begin) and is_named)


def _directory(path: Path) -> Contents:
    if (path / METADATA).exists():
        return _by_metadata(path)
    contents = _by_name(path)
    contents.findings.add(f"directory without {METADATA}, all of its files read in the order of their numbers")
    return contents


def _bag_of_file(path: Path) -> Contents:
    """The bag whose metadata.yaml lists a file among others; the file alone, if there is none."""
    if (path.parent / METADATA).exists():
        with contextlib.suppress(BagError, KeyError, TypeError, ValueError, AttributeError):
            listed = [Path(str(name)).name for name in _read_metadata(path.parent / METADATA)["relative_file_paths"]]
            if path.name in listed:
                contents = _by_metadata(path.parent)
                if len(listed) > 1:
                    contents.findings.add(f"{path.name} is one of {len(listed)} files of a split bag, all of them read")
                return contents
    contents = Contents([path])
    parts = [file.name for file in _files_in(path.parent) if file != path and _family(file) == _family(path)]
    if parts and _number(path) is not None:
        contents.findings.add(f"{path.name} read alone; beside it, of the same split bag: {', '.join(parts)}")
    return contents


def open_files(contents: Contents, keep_all: bool = False) -> Iterator[Storage]:
    """The files of a bag, one after the other, closed as the next is asked for.

    `keep_all`: with what only a copy needs, attachments and messages of channels that are not described.
    A file that is damaged beyond reading is reported, unless there is no other. Raises BagError.
    """
    for path in contents.files:
        with contextlib.ExitStack() as stack:
            try:
                file = path
                if is_packed(_beginning(path)):
                    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="agv_ncs_"))
                    file = Path(folder) / _unpacked_name(path.name)
                    if damage := unpack(path, file):
                        what = f"{path.name}: compressed file that is damaged, read up to there ({damage})"
                        contents.findings.add(what, is_loss=True)
                storage = _open(file, keep_all)
            except BagError as error:
                error = BagError(str(error).replace(str(file), str(path)))  # where it lies, not where it was unpacked
                if len(contents.files) == 1:
                    raise error from None
                contents.findings.add(f"file that cannot be read ({error})", is_loss=True)
                continue
            stack.callback(storage.close)
            yield storage


def _beginning(path: Path) -> bytes:
    try:
        refuse_irregular(path)
        with path.open("rb") as file:
            return file.read(512)
    except OSError as error:
        raise BagError(f"{path}: cannot be read: {error.strerror}") from None


def _open(path: Path, keep_all: bool) -> Storage:
    begin = _beginning(path)
    refuse_archive(begin, path)
    if begin.startswith(b"#ROSBAG V"):
        raise BagError(f"{path}: is a ROS 1 bag; {_convert(path)}")
    if begin.startswith(SQLITE) or (path.suffix.lower() == ".db3" and begin):
        from agv_analysis.bags.sqlite_file import SqliteFile

        return SqliteFile(path, keep_all)
    return McapFile(path, keep_all)


def _convert(path: Path) -> str:
    """How to make a ROS 2 bag of a ROS 1 bag."""
    return f"`pip install rosbags && rosbags-convert --src {path} --dst {path.with_suffix('')}` makes a ROS 2 bag of it"


# -- names ------------------------------------------------------------------------------------------------------------


def _unpacked_name(name: str) -> str:
    """Name of a file without the ending of its compression."""
    return next((name.removesuffix(ending) for ending in _PACKED if name.endswith(ending)), name)


def _number(path: Path) -> int | None:
    """Number of a file in a split bag, None if its name has none: 2 for "bag_2.mcap"."""
    found = re.search(r"_(\d+)$", Path(_unpacked_name(path.name)).stem)
    return int(found[1]) if found else None


def _family(path: Path) -> tuple[str, str]:
    """What the files of a split bag have in common: "bag" and ".mcap" for "bag_2.mcap"."""
    name = Path(_unpacked_name(path.name))
    return re.sub(r"_\d+$", "", name.stem), name.suffix.lower()


def _files_in(path: Path) -> list[Path]:
    """Files of a directory that hold messages by their endings, else by their first bytes, bag_2 before bag_10."""
    every = [file for file in path.iterdir() if file.is_file()]
    files = [file for file in every if Path(_unpacked_name(file.name)).suffix.lower() in _STORAGES]
    files = files or [file for file in every if _beginning(file).startswith((MCAP, SQLITE))]
    return sorted(files, key=lambda file: [int(n) if n.isdigit() else n for n in re.split(r"(\d+)", file.name)])


def _by_name(path: Path) -> Contents:
    """Files of a directory by their endings."""
    files = _files_in(path)
    if not files:
        raise BagError(f"{path}: no bag: there is no .mcap or .db3 file in this directory{_advice(path)}")
    mcap = [file for file in files if _family(file)[1] == ".mcap"]
    contents = Contents(mcap or files)
    for file in files:
        if file not in contents.files:
            contents.findings.add(f"{file.name} beside .mcap files, taken for another form of them, not read")
    _drop_packed_twins(contents)
    _report_holes(contents)
    first = min((number for file in contents.files if (number := _number(file)) is not None), default=0)
    if first > 0 and len(contents.files) > 1:
        contents.findings.add(f"split bag that begins with number {first}, the files before it not here")
    return contents


def _advice(path: Path) -> str:
    """What may have been meant where there is no bag."""
    old = next(iter(sorted(path.glob("*.bag"))), None)
    if old is not None:
        return f"; {old.name} is a ROS 1 bag: {_convert(old)}"
    inner = [folder.name for folder in sorted(path.iterdir()) if folder.is_dir() and _files_in(folder)]
    return f"; there is one in its folder{'s' * (len(inner) > 1)} {', '.join(inner)}" if inner else ""


def _drop_packed_twins(contents: Contents) -> None:
    """Read a file that is there compressed and not compressed once."""
    names = {file.name for file in contents.files}
    for file in list(contents.files):
        if (plain := _unpacked_name(file.name)) != file.name and plain in names:
            contents.files.remove(file)
            contents.findings.add(f"{file.name} not read, because {plain} is there, too")


def _report_holes(contents: Contents) -> None:
    """Report numbers that are missing among the files of a split bag."""
    families: dict[tuple[str, str], list[int]] = {}
    for file in contents.files:
        if (number := _number(file)) is not None:
            families.setdefault(_family(file), []).append(number)
    for (stem, suffix), numbers in families.items():
        for before, after in pairwise(sorted(numbers)):
            if after > before + 1:
                missing = f"{stem}_{before + 1}{suffix}"
                if after > before + 2:
                    missing += f" to {stem}_{after - 1}{suffix}"
                contents.findings.add(
                    f"{missing} missing from the files of a split bag", after - before - 1, is_loss=True
                )


# -- metadata.yaml ----------------------------------------------------------------------------------------------------


def _by_metadata(path: Path) -> Contents:
    try:
        about = _read_metadata(path / METADATA)
        listed = list(dict.fromkeys(_inside(path, str(name)) for name in about["relative_file_paths"] or ()))
        topics = [
            (str(topic["topic_metadata"]["name"]), str(topic["topic_metadata"].get("type", "")), topic["message_count"])
            for topic in about["topics_with_message_count"] or ()
        ]
        counts = {name: int(count) for name, _, count in topics}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        contents = _by_name(path)
        contents.findings.add(f"{METADATA} that is not understood ({type(error).__name__}: {error}), not used")
        return contents
    types = {name: kind for name, kind, _ in topics}
    contents = Contents([], counts, types, str(about.get("ros_distro") or ""))
    custom = about.get("custom_data")
    contents.custom_data = {str(key): str(text) for key, text in custom.items()} if isinstance(custom, dict) else None
    contents.files = _once(_present(path, listed, contents.findings), contents.findings)
    if not contents.files:
        raise BagError(f"{path}: none of the files that {METADATA} names is there{_advice(path)}")
    if about.get("compression_format") not in (None, "", "zstd"):
        contents.findings.add(f"compression {about['compression_format']!r} named by {METADATA}, which is not known")
    _report_holes(contents)
    return contents


def _present(path: Path, listed: list[Path], findings: Findings) -> list[Path]:
    """The files that metadata.yaml lists, or, where one is missing, those that are there in its place."""
    others = [file for file in _files_in(path) if file not in listed]
    present: list[Path] = []
    missing: list[Path] = []
    for file in listed:
        twin = next((other for other in others if _unpacked_name(other.name) == _unpacked_name(file.name)), None)
        if file.is_file():
            present.append(file)
        elif twin is not None:
            others.remove(twin)
            present.append(twin)
            findings.add(f"{file.name} named by {METADATA}, {twin.name} read in its place")
        else:
            missing.append(file)
    others = [file for file in others if not any(_unpacked_name(file.name) == _unpacked_name(p.name) for p in present)]
    renamed = others if missing or not listed else []
    if not listed:
        findings.add(f"{METADATA} that names no files, all files read in the order of their numbers")
    elif renamed:
        names, found = ", ".join(file.name for file in missing), ", ".join(file.name for file in renamed)
        findings.add(f"{names} named by {METADATA} but missing, {found} read in place of it")
    for file in missing[len(renamed) :]:
        findings.add(f"{file.name} named by {METADATA} but missing", is_loss=True)
    for file in others:
        if file not in renamed:
            findings.add(f"{file.name} not named by {METADATA}, not read")
    return present + renamed


def _once(files: list[Path], findings: Findings) -> list[Path]:
    """Files without those that are another name of one before them."""
    known: dict[tuple[int, int], Path] = {}
    for file in files:
        about = file.stat()
        first = known.setdefault((about.st_dev, about.st_ino), file)
        if first is not file:
            findings.add(f"{file.name} is {first.name} by another name, not read again")
    return list(known.values())


def _read_metadata(path: Path) -> dict[str, Any]:
    """Content of a metadata.yaml. Raises ValueError, TypeError or KeyError if it is none."""
    import yaml

    try:
        refuse_irregular(path)
        with path.open("rb") as file:
            text = file.read(min(path.stat().st_size, _MAX_METADATA) + 1)
        if len(text) > _MAX_METADATA:
            raise ValueError(f"it has more than {_MAX_METADATA} bytes")
        about = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))["rosbag2_bagfile_information"]
    except OSError as error:
        raise BagError(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from None
    if not isinstance(about, dict):
        raise TypeError("it holds no mapping")
    return about


def _inside(directory: Path, name: str) -> Path:
    """A file of the directory; older versions of rosbag2 put the directory's name before the file's."""
    return directory / Path(name).name
