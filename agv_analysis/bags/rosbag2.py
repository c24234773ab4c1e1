"""The files of a bag: what a rosbag2 directory holds, with metadata.yaml or without."""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from agv_analysis.bags.bag_errors import BagError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.mcap_file import McapFile
from agv_analysis.bags.storage import Storage

METADATA = "metadata.yaml"

_PACKED = ".zstd"
"""Ending that rosbag2 adds to the files that it compresses as a whole."""

_MOST_TIMES = 1000
_ALWAYS_UNPACKED = 2**30
"""A file may decompress to this many times its size, or to this many bytes."""

_PIECE = 2**22

_MAX_METADATA = 2**26
"""Most bytes of a metadata.yaml; that of a bag with a thousand topics and files has one million."""


@dataclass
class Contents:
    """Where the messages of a bag are."""

    files: list[Path]
    is_mcap: bool = True
    """Else `files` is what the library rosbags is to open."""
    counts: dict[str, int] = field(default_factory=dict)
    """Messages by topic, as metadata.yaml has it."""
    findings: Findings = field(default_factory=Findings)


def locate(path: Path) -> Contents:
    """Contents of a rosbag2 directory, or of a bare file. Raises BagError if there is no bag."""
    if not path.exists():
        raise BagError(f"{path}: there is no such file or directory")
    if not path.is_dir():
        return Contents([path], is_mcap=path.suffix != ".db3")
    if (path / METADATA).exists():
        return _by_metadata(path)
    contents = _by_name(path)
    contents.findings.add(f"directory without {METADATA}, all of its files read in the order of their numbers")
    return contents


def open_files(contents: Contents, keep_attachments: bool = False) -> Iterator[Storage]:
    """The files of a bag, one after the other, closed as the next is asked for.

    A file that is damaged beyond reading is reported, unless there is no other. Raises BagError.
    """
    for path in contents.files:
        with contextlib.ExitStack() as stack:
            try:
                file = path
                if path.suffix == _PACKED:
                    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="agv_ncs_"))
                    file = _unpack(path, Path(folder), contents.findings)
                storage = _open(file, contents.is_mcap, keep_attachments)
            except BagError as error:
                if len(contents.files) == 1:
                    raise
                contents.findings.add(f"file that cannot be read ({error})", is_loss=True)
                continue
            stack.callback(storage.close)
            yield storage


def _unpack(path: Path, folder: Path, findings: Findings) -> Path:
    """A file that was compressed as a whole, inflated, as far as it goes, to a file in `folder`. Raises BagError."""
    import zstandard

    target = folder / path.stem
    try:
        left = max(_ALWAYS_UNPACKED, _MOST_TIMES * path.stat().st_size)
        with path.open("rb") as packed, target.open("xb") as file:
            stream = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while left > 0 and (piece := stream.read(_PIECE)):
                left -= file.write(piece)
    except zstandard.ZstdError as error:
        findings.add(f"{path.name}: compressed file that is damaged, read up to there ({error})", is_loss=True)
    except OSError as error:
        raise BagError(f"{path}: cannot be unpacked to {folder}: {error.strerror}") from None
    if left <= 0:
        raise BagError(f"{path}: inflates to more than {_MOST_TIMES} times its size, as no recording does")
    return target


def _open(path: Path, is_mcap: bool, keep_attachments: bool) -> Storage:
    if is_mcap:
        return McapFile(path, keep_attachments)
    from agv_analysis.bags.rosbags_file import RosbagsFile

    return RosbagsFile(path)


def _by_name(path: Path) -> Contents:
    """Files of a directory by their endings, bag_2 before bag_10."""
    names = sorted(
        path.iterdir(), key=lambda file: [int(n) if n.isdigit() else n for n in re.split(r"(\d+)", file.name)]
    )
    mcap = [name for name in names if name.name.endswith((".mcap", f".mcap{_PACKED}"))]
    if mcap:
        return Contents(mcap)
    sqlite = [name for name in names if name.suffix == ".db3"]
    if sqlite:
        return Contents(sqlite, is_mcap=False)
    raise BagError(f"{path}: no bag: there is no .mcap or .db3 file in this directory")


def _numbered(file: Path) -> list[tuple[int, str]]:
    """Sort key of a file's name, its numbers by their value."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", file.name)]


def _by_metadata(path: Path) -> Contents:
    try:
        about = _read_metadata(path / METADATA)
        listed = [_inside(path, str(name)) for name in about["relative_file_paths"]]
        storage, mode = str(about["storage_identifier"]), str(about.get("compression_mode") or "").lower()
        counts = {
            str(topic["topic_metadata"]["name"]): int(topic["message_count"])
            for topic in about["topics_with_message_count"]
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        contents = _by_name(path)
        contents.findings.add(f"{METADATA} that is not understood ({type(error).__name__}: {error}), not used")
        return contents
    if mode == "message" or (storage != "mcap" and mode != "file"):
        return Contents([path], is_mcap=False, counts=counts)
    if mode == "file" and any(file.suffix != _PACKED for file in listed):
        return Contents([path], is_mcap=False, counts=counts)
    contents = Contents([file for file in listed if file.exists()], is_mcap=storage == "mcap", counts=counts)
    for file in listed:
        if not file.exists():
            contents.findings.add(f"{file.name} named by {METADATA} but missing", is_loss=True)
    for file in sorted(path.glob("*.mcap")):
        if file not in listed:
            contents.findings.add(f"{file.name} not named by {METADATA}, not read")
    if not contents.files:
        raise BagError(f"{path}: none of the files that {METADATA} names is there")
    return contents


def _read_metadata(path: Path) -> dict[str, Any]:
    """Content of a metadata.yaml. Raises ValueError, TypeError or KeyError if it is none."""
    try:
        with path.open("rb") as file:
            text = file.read(min(path.stat().st_size, _MAX_METADATA) + 1)
        if len(text) > _MAX_METADATA:
            raise ValueError(f"it has more than {_MAX_METADATA} bytes")
        about = yaml.safe_load(text)["rosbag2_bagfile_information"]
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
