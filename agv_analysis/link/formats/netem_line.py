"""A text file with a line for netem, as people write it or as `tc qdisc show` prints it: a setting, no measurement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import head_of
from agv_analysis.link.measurement import MeasurementError, Setting
from agv_analysis.link.netem_text import is_netem, read_netem
from agv_plant.parameters import ChannelParameters


def _lines(head: bytes) -> list[str]:
    text = head.decode("utf-8", "replace").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if is_netem(line)]
    # Options on lines of their own are one link, commands are one each.
    return lines if any("netem" in line.split() for line in lines) else [" ".join(lines)][: len(lines)]


def _matches(head: bytes, path: Path) -> bool:
    return len(head) < 65536 and bool(_lines(head))


def _read(path: Path, options: Options) -> Setting:
    head = head_of(path)
    lines = _lines(head)
    if not lines:
        raise MeasurementError(f"{path}: has no line for netem, as in: delay 20ms 5ms loss gemodel 1% 10%")
    if len(lines) > 1:
        devices = ", ".join(_device(line) or "no device" for line in lines)
        raise MeasurementError(
            f"{path}: has {len(lines)} lines for netem, which are one link each ({devices}): leave one of them"
        )
    found = setting(lines[0], str(path))
    return replace(found, differences=(*found.differences, *_others(head, _device(lines[0]))))


def _device(line: str) -> str:
    """The device that a command or a line of tc is about; empty if it names none."""
    words = line.split()
    return words[words.index("dev") + 1] if "dev" in words[:-1] else ""


_HARMLESS = ("netem", "noqueue", "pfifo", "pfifo_fast", "bfifo", "fq", "fq_codel", "mq", "prio")
"""Kinds of qdisc that a message of the loop does not meet, or does not wait in."""


def _others(head: bytes, device: str) -> Iterator[str]:
    """A sentence for each further qdisc on the device: it shapes the link as well."""
    for line in head.decode("utf-8", "replace").splitlines():
        words = line.split()
        kind = words[1] if words[:1] == ["qdisc"] and len(words) > 1 else ""
        if kind and kind not in _HARMLESS and _device(line) == device:
            yield f"the qdisc {kind} of {device or 'the same device'} acts on the link as well, and is left out here"


def setting(line: str, source: str) -> Setting:
    """A line for netem as a link. Raises NetemError."""
    channel, differences = read_netem(line, ChannelParameters())
    return Setting(source, "netem", line.strip(), channel, differences)


FORMAT = Format("netem", "line for netem or of tc qdisc", 30, _matches, _read)
