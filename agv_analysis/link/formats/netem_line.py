"""A text file with a line for netem, as people write it or as `tc qdisc show` prints it: a setting, no measurement."""

from __future__ import annotations

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
    lines = _lines(head_of(path))
    if not lines:
        raise MeasurementError(f"{path}: has no line for netem, as in: delay 20ms 5ms loss gemodel 1% 10%")
    if len(lines) > 1:
        raise MeasurementError(f"{path}: has {len(lines)} lines for netem, which are one link each: leave one")
    return setting(lines[0], str(path))


def setting(line: str, source: str) -> Setting:
    """A line for netem as a link. Raises NetemError."""
    channel, differences = read_netem(line, ChannelParameters())
    return Setting(source, "netem", line.strip(), channel, differences)


FORMAT = Format("netem", "line for netem or of tc qdisc", 30, _matches, _read)
