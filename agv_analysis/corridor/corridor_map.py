"""Corridors in a map of margins, at each of thousands of points, for loops at constant speed.

Under `hold` one outage of n slots leads a v T_s n (n + 1) / 2 along the track, a = T_s K_x; under `align` nowhere: that
is so for Kanayama's law on a drive that obeys at once. Any other loop is driven through outages, at each point from one
place, for all are alike on a line and on a circle.

No sequence of outages may have longer ones than a single one, nor than those whose repetition dies out. The corridor is
left about as often as an outage is longer than a single one may be: what shorter ones do together is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from agv_analysis.corridor.corridor import NOT_ALONE
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.rare_leaving import outages_of
from agv_analysis.corridor.single_outage import roughly
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.link.markov_channel import Chain, chain_of
from agv_analysis.metrics.confidence import computed_after_of
from agv_analysis.scenario import Scenario
from agv_analysis.stability.derived_loop import has_closed_form
from agv_analysis.stability.margin_map import CURVATURE, SPEED, TS, MarginMap, axes_of, scenario_at
from agv_analysis.stability.margin_map_points import LIMIT
from agv_ros.counted import counted
from agv_ros.errors import UserError

N_ANY, P_HOUR = "n_any", "p_hour"

TITLES = {
    N_ANY: "longest outage that the corridor allows",
    P_HOUR: "probability to leave the corridor in an hour",
}

_HOUR = 3600.0


def with_corridor(
    found: MarginMap, scenario: Scenario, progress: Callable[[int], None] = lambda done: None
) -> MarginMap:  # fmt: skip
    """A map with N_ANY and P_HOUR of the scenario's corridor; as it is if there is none.

    n_any is -1 where the loop is unstable, or outside, without outages; p_hour is left out where the uplink is no
    Markov chain. `progress` receives the number of points done, where each is driven. Raises UserError where an outage
    alone is not what the loop meets.
    """
    widths = widths_of(scenario.error_detector)
    if widths is None:
        return found
    if not (scenario.relay.uplink.is_direct and scenario.relay.downlink.is_direct):
        raise UserError(f"a map of a corridor asks for outages alone: {NOT_ALONE}")
    policy, at_first = scenario.error_detector.policy, {name: value for name, (value, _) in axes_of(scenario).items()}
    rows, columns = np.meshgrid(found.first, found.second, indexing="ij")
    axes = {found.axes[0]: rows, found.axes[1]: columns}
    at = {name: axes.get(name, np.full(rows.shape, value)) for name, value in at_first.items()}
    v = np.array([np.abs(at[SPEED]).max()])
    if policy in ("hold", "align") and has_closed_form(scenario, v, v * np.abs(at[CURVATURE]).max()):
        advance = at[TS] ** 2 * at["kx"] * at[SPEED] if policy == "hold" else np.zeros(rows.shape)
        single = np.vectorize(lambda one: _longest(one, widths), otypes=[np.int64])(advance)
        progress(rows.size)
    else:
        places = [{name: float(values[place]) for name, values in at.items()} for place in np.ndindex(rows.shape)]
        driven = []
        for place in places:
            driven.append(_driven(scenario, place, widths))
            progress(len(driven))
        single = np.array(driven, dtype=np.int64).reshape(rows.shape)
    bursts = found.margins["n_bursts"]
    margins = {**found.margins, N_ANY: np.minimum(single, bursts)}
    chain = chain_of(scenario.relay.uplink)
    if chain is not None:
        rate = np.vectorize(lambda n: _rate(chain, n), otypes=[np.float64])(single)
        margins[P_HOUR] = np.where(margins[N_ANY] < 0, 1.0, -np.expm1(-rate * _HOUR / at[TS]))
    return replace(found, margins=margins)


def best_point(found: MarginMap) -> str:
    """The point of a map that leaves its corridor most rarely, of equal ones that with the largest n_any, in words.

    Where the uplink is not a Markov chain, that with the largest n_any. Empty without a corridor, or if all points
    leave it without outages.
    """
    n_any, p_hour = found.margins.get(N_ANY), found.margins.get(P_HOUR)
    if n_any is None or (n_any < 0).all():
        return ""
    rank = (-n_any,) if p_hour is None else (-n_any, p_hour)
    row, column = np.unravel_index(np.lexsort(tuple(key.ravel() for key in rank))[0], n_any.shape)
    place = zip(found.labels, (found.first[row], found.second[column]), strict=True)
    where = ", ".join(_with_unit(label, float(value)) for label, value in place)
    n = int(n_any[row, column])
    outages = "any outages" if n >= LIMIT else f"any outages of up to {counted(n, 'slot')}"
    kept = f"best at {where}: stays inside in {outages}"
    if p_hour is None:
        return kept
    return f"{kept}, leaves in an hour with a probability {computed_after_of(p_hour[row, column].item())}"


def _driven(scenario: Scenario, place: Mapping[str, float], widths: Widths) -> int:
    """Longest single outage at a point, LIMIT where all that are tried stay inside; -1: it is outside without any."""
    v, turns = place[SPEED], abs(place[SPEED] * place[CURVATURE]) > 0.0
    lap = 2.0 * math.pi / abs(v * place[CURVATURE]) if turns else _LINE
    track = f"error_detector.track={'circle' if turns else 'line'}", f"error_detector.speed={v!r}"
    at_place = scenario_at(scenario, place)
    at_place = at_place.with_settings([*track, f"error_detector.lap_time={lap!r}"], "the map")
    n = roughly(LapLoop(at_place, widths), places=1)
    return LIMIT if n is None else n


_LINE = 20.0
"""Duration of a straight track [s]: so long a loop is driven before an outage begins."""


def _longest(advance: float, widths: Widths) -> int:
    """Largest n with advance n (n + 1) / 2 within the corridor along the track, LIMIT at most."""
    along = min(widths.distance, widths.along)
    if advance * LIMIT * (LIMIT + 1) / 2 <= along:
        return LIMIT
    n = int((math.sqrt(1.0 + 8.0 * along / advance) - 1.0) / 2.0) + 1
    while advance * n * (n + 1) / 2 > along:
        n -= 1
    return n


def _rate(chain: Chain, n: int) -> float:
    """Share of the slots at which an outage becomes longer than n slots."""
    return 0.0 if n >= LIMIT or chain.loss_rate == 0.0 else outages_of(chain, n + 1)


def _with_unit(label: str, value: float) -> str:
    """The value of an axis: `kx = 25 1/s` of one with the label `kx [1/s]`."""
    name, _, unit = label.rstrip("]").partition(" [")
    return f"{name} = {value:.4g} {unit}".rstrip()
