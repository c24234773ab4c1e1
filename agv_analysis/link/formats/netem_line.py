"""A text file with a line for netem, as people write it or as `tc qdisc show` prints it: a setting, no measurement.

What `tc -j qdisc show` prints, a list of JSON with seconds and shares, is put into such lines first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import head_of
from agv_analysis.link.measurement import MeasurementError, Setting
from agv_analysis.link.netem_text import is_netem, read_netem
from agv_plant.parameters import ChannelParameters
from agv_ros.json_text import parse_json


def _text(head: bytes) -> str:
    text = head.decode("utf-8", "replace")
    if text.lstrip().startswith("["):
        try:
            return "\n".join(map(_line_of, parse_json(text)))
        except (ValueError, ArithmeticError, AttributeError, TypeError, LookupError):  # JSON of something else
            return ""
    return text.replace("\\\n", " ")


def _line_of(qdisc: dict[str, Any]) -> str:
    """A member of what `tc -j qdisc show` prints, as `tc qdisc show` prints it."""
    words = ["qdisc", str(qdisc["kind"]), *(["dev", str(qdisc["dev"])] if "dev" in qdisc else [])]
    options = (qdisc.get("options") or {}) if qdisc["kind"] == "netem" else {}
    for name, figures in options.items():
        if not isinstance(figures, dict):
            words += ["gap", str(figures)] if name == "gap" and figures and "reorder" not in options else []
        elif name == "delay":
            jitter, correlation = figures.get("jitter", 0), figures.get("correlation", 0)
            words += ["delay", f"{figures['delay']}s", f"{jitter}s", _percent(correlation)]
        elif name == "rate":
            words += ["rate", f"{8 * figures['rate']}bit"]
        elif name == "slot":
            words += ["slot"]
        else:
            words += [*name.split("-"), *map(_percent, figures.values())]
    return " ".join(words)


def _percent(share: float) -> str:
    return f"{100 * Decimal(str(share)):f}%"


def _lines(head: bytes) -> list[str]:
    lines = [line for line in _text(head).splitlines() if is_netem(line)]
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
    for line in _text(head).splitlines():
        words = line.split()
        kind = words[1] if words[:1] == ["qdisc"] and len(words) > 1 else ""
        if kind and kind not in _HARMLESS and _device(line) == device:
            yield f"the qdisc {kind} of {device or 'the same device'} acts on the link as well, and is left out here"


def setting(line: str, source: str) -> Setting:
    """A line for netem as a link. Raises NetemError."""
    channel, differences = read_netem(line, ChannelParameters())
    return Setting(source, "netem", line.strip(), channel, differences)


FORMAT = Format("netem", "line for netem or of tc qdisc", 30, _matches, _read)
