"""The page of a map of margins: a heat map for each margin, points to click."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.corridor.corridor_map import N_ANY, P_HOUR, TITLES
from agv_analysis.metrics.confidence import computed
from agv_analysis.report.heat_map import colour_scale, heat_map_layout
from agv_analysis.report.page import fill, versions, write_page
from agv_analysis.report.panels import plain
from agv_analysis.report.sweep_table import number
from agv_analysis.report.tiles import Tile
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.stability.margin_map import SPEED, TS, MarginMap, axes_of, map_columns
from agv_analysis.sweep.picture import INSTABILITY_COLOURS
from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_ros.counted import counted

_TICKS = (-1, 0, 1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)
"""Numbers of slots that a colour bar names."""

_COLOURS = ("#2f6fdb", "#7b3fb5", "#0a8f6a", "#b8860b")

_WORDS = {TS: "sampling period T_s", "v": "speed v of the reference", "curvature": "curvature of the track"}
"""Of axes that are not gains."""


def write_map_page(found: MarginMap, scenario: Scenario, path: Path, command: str) -> None:
    """Write the page of a map; `command` repeats it. Raises UserError as `write_report`."""
    titles = _titles()
    parameters = scenario.to_yaml(of_all_parts=True)
    up, across = (axis_in_words(scenario, axis) for axis in found.axes)
    rows, columns = len(found.first), len(found.second)
    points = [
        {found.axes[0]: x, found.axes[1]: y, **{name: n[i, j].item() for name, n in found.margins.items()}}
        for i, x in enumerate(found.first.tolist())
        for j, y in enumerate(found.second.tolist())
    ]
    html = fill(
        "map.html.j2",
        figures={name: _heat_map(found, name, (across, up)) for name in found.margins},
        data={
            "sentence": map_sentence(found, scenario), "axes": list(found.axes), "points": points,
            "titles": {**titles, found.axes[0]: up, found.axes[1]: across},
            "settings": _settings(scenario), "speed": axes_of(scenario)[SPEED][0], "parameters": parameters,
            "versions": versions(),
        },
        title="agv_ncs: map of margins",
        verdict=map_sentence(found, scenario),
        word="unknown",
        tiles=list(_tiles(found, scenario)),
        at=f"{rows} by {counted(columns, 'point')} about the scenario's own",
        has_borders=any(_has_border(name, margins) for name, margins in found.margins.items()),
        sections=[{"key": name, "title": _capital(titles[name]), "height": 460} for name in found.margins],
        chosen=_nearest(found, scenario),
        columns=columns,
        scenario=scenario,
        parameters=parameters,
        reproduce=command,
    )  # fmt: skip
    write_page(html, path)


def map_sentence(found: MarginMap, scenario: Scenario) -> str:
    """What the map says at the point next to the scenario's own, in one sentence."""
    row = _nearest(found, scenario)
    i, j = divmod(row, len(found.second))
    values = zip(found.axes, (found.first[i].item(), found.second[j].item()), strict=True)
    at = ", ".join(
        f"{_symbol(scenario, axis)} = {number(value)} {axes_of(scenario)[axis][1]}" for axis, value in values
    )
    said = (f"{title}: {_texts(found, name)[i][j]}" for name, title in _shown(found))
    return f"At {at}: {'; '.join(said)}."


def _tiles(found: MarginMap, scenario: Scenario) -> Iterator[Tile]:
    """What is asked first of a map: what the scenario's own point survives, why no more, where, how far, how sure."""
    i, j = divmod(_nearest(found, scenario), len(found.second))
    slots = {name: margins for name, margins in found.margins.items() if name not in (N_ANY, P_HOUR)}
    least = min(slots, key=lambda name: slots[name][i, j])
    n, titles = int(slots[least][i, j]), _titles()
    if n < 0:
        yield Tile("word", "At this point", "unstable", "even without outages")
    else:
        note = f"the smallest margin, by which all of them are survived: {titles[least]}"
        yield Tile("word", "Survived at this point", counted(n, "slot"), note)
    without_outages = slots[least] >= 0
    points = counted(without_outages.size, "point")
    yield Tile(
        "stable",
        "Stable without outages",
        f"{int(without_outages.sum())} of {points}",
        "on the whole map" if without_outages.all() else "the others are beyond the dashed line",
    )
    if N_ANY in found.margins:
        yield Tile("deviation", "Within the corridor", _texts(found, N_ANY)[i][j], titles[N_ANY])
    else:
        yield Tile("deviation", "How far it strays", "not asked", "--corridor METRES maps it")
    yield Tile("sure", "How sure", "computed", "for small errors at constant speed and curvature; nothing is simulated")


def _symbol(scenario: Scenario, axis: str) -> str:
    """The letter of an axis, as `K_x`; its name where its meaning has none."""
    found = re.search(r"\b[A-Z]\w*_\w+", axis_in_words(scenario, axis))
    return found[0] if found else axis


def axis_in_words(scenario: Scenario, axis: str) -> str:
    """What an axis of a map is called, with its unit."""
    law = CONTROL_LAWS.find(scenario.controller.law)
    meanings = {known.name: known.description for known in law.parameters}
    unit = axes_of(scenario)[axis][1]
    words = _WORDS.get(axis) or meanings.get(axis) or axis
    return f"{words} [{unit}]" if unit else words


def _titles() -> dict[str, str]:
    return {**{column.name: column.title for column in map_columns()}, **TITLES}


def _shown(found: MarginMap) -> Iterator[tuple[str, str]]:
    titles = _titles()
    return ((name, titles[name]) for name in found.margins)


def _texts(found: MarginMap, name: str) -> list[list[str]]:
    """What a margin is at each point, in words."""
    values = found.margins[name]
    if name != P_HOUR:
        return [[_said(name, value) for value in row] for row in values.tolist()]
    outside = found.margins[N_ANY] < 0
    return [
        ["1: it is outside even without outages" if is_outside else computed(value) for value, is_outside in row]
        for row in np.stack((values, outside), axis=-1).tolist()
    ]


def _said(name: str, value: float) -> str:
    outside = "outside" if name == N_ANY else "unstable"
    return f"{outside} even without outages" if value < 0 else counted(value, "slot")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _nearest(found: MarginMap, scenario: Scenario) -> int:
    """Number of the point next to the scenario's own, row by row."""
    own = axes_of(scenario)
    i, j = (
        int(np.abs(values - own[axis][0]).argmin())
        for axis, values in zip(found.axes, (found.first, found.second), strict=True)
    )
    return i * len(found.second) + j


def _heat_map(found: MarginMap, name: str, words: tuple[str, str]) -> dict[str, Any]:
    """A margin over the second axis across and the first one up; the borders of stability of all margins in it."""
    values = np.asarray(found.margins[name], dtype=np.float64)
    x, y = found.second.tolist(), found.first.tolist()
    heat: dict[str, Any] = {"type": "heatmap", "x": x, "y": y, "colorbar": {"thickness": 14}}
    if name == P_HOUR:
        scale = colour_scale(INSTABILITY_COLOURS)
        heat |= {"z": [plain(row) for row in values], "zmin": 0.0, "zmax": 1.0, "colorscale": scale}
    else:
        heat |= _by_size(values)
    heat["text"] = _texts(found, name)
    heat["hovertemplate"] = f"{words[0]}: %{{x:.4g}}<br>{words[1]}: %{{y:.4g}}<br>%{{text}}<extra></extra>"
    layout = heat_map_layout(*words)
    layout["xaxis"] |= _scale(found.second)
    layout["yaxis"] |= _scale(found.first)
    return {"data": [heat, *_borders(found, x, y)], "layout": layout}


def _by_size(values: Floats) -> dict[str, Any]:
    """Colours by the logarithm of a number of slots, green where many are survived."""
    size = np.log10(values + 2.0)
    top = max(1.0, float(size.max()))
    scale = colour_scale(INSTABILITY_COLOURS[::-1])
    ticks = [tick for tick in _TICKS if np.log10(tick + 2.0) <= top]
    named = {"tickvals": np.log10(np.array(ticks) + 2.0).tolist(), "ticktext": [_tick(tick) for tick in ticks]}
    return {
        "z": [plain(row) for row in size], "zmin": 0.0, "zmax": top, "colorscale": scale,
        "colorbar": {"thickness": 14, "title": {"text": "slots", "side": "right"}, **named},
    }  # fmt: skip


def _tick(slots: int) -> str:
    return "unstable" if slots < 0 else str(slots)


def _scale(values: Floats) -> Mapping[str, Any]:
    is_wide = values.min() > 0.0 and values.max() >= 10.0 * values.min()
    return {"type": "log"} if is_wide else {}


def _has_border(name: str, margins: Floats) -> bool:
    """Is the loop stable without outages at some points and not at others, by a margin that says so?"""
    return name != P_HOUR and bool(margins.min() < 0.0 <= margins.max())


def _borders(found: MarginMap, x: list[float], y: list[float]) -> Iterator[dict[str, Any]]:
    """Where the loop ceases to be stable without outages, by each margin that says so here."""
    for (name, title), colour in zip(_shown(found), _COLOURS, strict=False):
        values = np.asarray(found.margins[name], dtype=np.float64)
        if _has_border(name, values):
            yield {
                "type": "contour", "name": f"border: {title}", "x": x, "y": y, "showscale": False, "hoverinfo": "skip",
                "z": [plain(row) for row in np.clip(values, -1.0, 0.0)], "showlegend": True,
                "contours": {"start": -0.5, "end": -0.5, "size": 1.0, "coloring": "none"},
                "line": {"color": colour, "dash": "dash", "width": 2},
            }  # fmt: skip


def _settings(scenario: Scenario) -> dict[str, str]:
    """The parameter that sets an axis, of those that one parameter sets."""
    law = scenario.controller.law
    prefix = "controller" if law == KANAYAMA else f"controller.{law}"
    gains = {known.name: f"{prefix}.{known.name}" for known in CONTROL_LAWS.find(law).parameters}
    return {**gains, TS: "plant.ts"}
