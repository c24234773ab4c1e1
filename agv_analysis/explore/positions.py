"""Between what stands on the page, positions of sliders and an address, and the values of settings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl, urlencode

from agv_analysis.explore.sliders import CHOICES, SLIDERS

_BY_KEY = {slider.key: slider for slider in SLIDERS}


def position_of(key: str, value: Any) -> Any:
    """Where a slider stands for a value; of what is not a slider the value itself."""
    return _BY_KEY[key].position_of(value) if key in _BY_KEY else value


def value_of(key: str, position: Any, at_first: Mapping[str, Any]) -> Any:
    """The value of a position; what stands where it stood at first has the value that it had, to the last digit."""
    if key not in _BY_KEY:
        return position
    slider = _BY_KEY[key]
    return at_first[key] if position == slider.position_of(at_first[key]) else slider.value_at(position)


def difference(now: Mapping[str, Any], pinned: Mapping[str, Any]) -> str:
    """What a pinned setting has otherwise than that of now, in words."""
    found = [
        f"{_name(key)} {_short(value)} (now {_short(now[key])})" for key, value in pinned.items() if value != now[key]
    ]
    return f"Pinned, dotted: {'; '.join(found)}" if found else "Pinned, dotted: the setting of now"


def _name(key: str) -> str:
    return _BY_KEY[key].label if key in _BY_KEY else CHOICES[key].label if key in CHOICES else key


def _short(value: Any) -> str:
    if isinstance(value, str):
        return ", ".join(value.split()) or "nothing"
    return f"{value:g}"


def to_hash(now: Mapping[str, Any], at_first: Mapping[str, Any]) -> str:
    """What differs from the setting at first, for the address of the page."""
    return urlencode({key: json.dumps(value) for key, value in now.items() if value != at_first[key]})


def from_hash(text: str, at_first: Mapping[str, Any]) -> dict[str, Any]:
    """What an address says of a setting; what is of no key, or of another kind than its value, is left out."""
    found = {}
    for key, literal in parse_qsl(text.removeprefix("#")):
        try:
            value = json.loads(literal)
        except (ValueError, RecursionError):
            continue
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if key in _BY_KEY and is_number:
            found[key] = min(_BY_KEY[key].high, max(_BY_KEY[key].low, value))
        elif key in at_first and key not in _BY_KEY and isinstance(value, str):
            found[key] = value
    return {key: value for key, value in found.items() if key not in CHOICES or value in CHOICES[key].names}
