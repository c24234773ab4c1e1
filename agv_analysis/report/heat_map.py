"""What the heat maps of the pages have in common: colours and layout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def colour_scale(colours: Sequence[str]) -> list[list[float | str]]:
    """Three colours as plotly's scale from the lowest to the highest value."""
    return [[place, colour] for place, colour in zip((0.0, 0.5, 1.0), colours, strict=True)]


def heat_map_layout(across: str, up: str) -> dict[str, Any]:
    """Layout of a heat map whose axes are called so, on the page's own background."""
    return {
        "xaxis": {"title": {"text": across}}, "yaxis": {"title": {"text": up}},
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 60, "r": 12, "t": 32, "b": 44}, "modebar": {"bgcolor": "rgba(0,0,0,0)"},
        "legend": {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"},
    }  # fmt: skip
