"""The page of what a loop asks of its radio: tables, and the curves of losses that it takes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.report.page import fill, versions, write_page
from agv_analysis.report.panels import DRIVEN, MARKERS, Line, Panel
from agv_analysis.report.plotly import figure
from agv_analysis.requirements.loop_requirements import LoopRequirements
from agv_analysis.scenario import Scenario

Sections = Mapping[str, Sequence[Sequence[str]]]


def write_requirements(
    path: Path, scenario: Scenario, found: LoopRequirements, sections: Sections, heads: Sections, data: dict[str, Any]
) -> None:
    """Write the page: `sections` are tables by title, with the `heads` of those that have one.

    Raises UserError as `write_report`.
    """
    drawn = {panel.key: figure([panel]) for panel in _panels(found)}
    parameters = scenario.to_yaml(of_all_parts=True)
    html = fill(
        "requirements.html.j2",
        figures=drawn,
        data={**data, "parameters": parameters, "versions": versions()},
        title="agv_ncs: what the loop asks of its radio",
        verdict=sentence(found),
        word="infeasible" if found.infeasible else "asymptotic",
        tables=[(title, heads.get(title, ()), rows) for title, rows in sections.items()],
        sections=[{"key": panel.key, "title": panel.title, "height": 360} for panel in _panels(found)],
        scenario=scenario,
        parameters=parameters,
        reproduce="agv-ncs require params.yaml --report report.html",
    )
    write_page(html, path)


def sentence(found: LoopRequirements) -> str:
    """What the loop asks, in one sentence."""
    if found.infeasible:
        return "No radio would do: the loop does not settle even without losses"
    survival, latency = found.survival_time, found.latency
    time = "any outage" if survival is None else f"outages of {1e3 * survival:.4g} ms"
    late = "any latency" if latency is None else f"a latency of {1e3 * latency:.4g} ms"
    return f"Every {1e3 * found.transfer_interval:g} ms a message; {time} at most, or {late}"


def _panels(found: LoopRequirements) -> Iterator[Panel]:
    ts = found.transfer_interval
    bursts = [(rate, 1e3 * ts * burst) for rate, burst in found.bursts if burst is not None and math.isfinite(burst)]
    if len(bursts) > 1:
        x, y = (np.array(column) for column in zip(*bursts, strict=True))
        lines = (Line("mean burst that is taken", x, y, DRIVEN), Line("computed", x, y, DRIVEN, MARKERS))
        yield Panel(
            "bursts", "Losses in bursts: below the line the loop holds", "loss rate", "mean burst [ms]", lines, log=True
        )
    if len(found.delays) > 1:
        x, y = (np.array(column) for column in zip(*found.delays, strict=True))
        lines = (Line("losses that are taken", 1e3 * x, y, DRIVEN), Line("computed", 1e3 * x, y, DRIVEN, MARKERS))
        yield Panel(
            "delays", "Losses behind a constant delay: below the line the loop holds", "delay [ms]", "loss rate", lines
        )
