"""Corridors in a map of margins, at each of thousands of points, by closed forms for loops at constant speed.

Under `hold` one outage of n slots leads a v T_s n (n + 1) / 2 along the track, a = T_s K_x; under `align` nowhere. No
sequence of outages may have longer ones than a single one, nor than those whose repetition dies out. The corridor is
left about as often as an outage is longer than a single one may be: what shorter ones do together is left out.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from agv_analysis.corridor.rare_leaving import outages_of
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.link.markov_channel import Chain, chain_of
from agv_analysis.scenario import Scenario
from agv_analysis.stability.derived_loop import has_closed_form
from agv_analysis.stability.margin_map import CURVATURE, SPEED, TS, MarginMap, axes_of
from agv_analysis.stability.margin_map_points import LIMIT
from agv_ros.errors import UserError

N_ANY, P_HOUR = "n_any", "p_hour"

TITLES = {N_ANY: "any outages up to n in the corridor", P_HOUR: "probability to leave in an hour"}

_HOUR = 3600.0


def with_corridor(found: MarginMap, scenario: Scenario) -> MarginMap:
    """A map with N_ANY and P_HOUR of the scenario's corridor; as it is if there is none.

    n_any is -1 where the loop is unstable without outages; p_hour is left out where the uplink is no Markov chain.
    Raises UserError where there is no closed form.
    """
    widths = widths_of(scenario.error_detector)
    if widths is None:
        return found
    policy, at_first = scenario.error_detector.policy, axes_of(scenario)
    v = np.array([at_first[SPEED][0]])
    if policy == "predict" or not has_closed_form(scenario, v, v * at_first[CURVATURE][0]):
        raise UserError(
            "a map of a corridor is computed for Kanayama's law, a drive that obeys at once, hold and align"
        )
    rows, columns = np.meshgrid(found.first, found.second, indexing="ij")

    def of(axis: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        values = {found.axes[0]: rows, found.axes[1]: columns}
        return values.get(axis, np.full(rows.shape, at_first[axis][0]))

    ts = of(TS)
    advance = ts * ts * of("kx") * of(SPEED) if policy == "hold" else np.zeros(rows.shape)
    single = np.vectorize(lambda one: _longest(one, widths), otypes=[np.int64])(advance)
    bursts = found.margins["n_bursts"]
    margins = {**found.margins, N_ANY: np.minimum(single, bursts)}
    chain = chain_of(scenario.relay.uplink)
    if chain is not None:
        rate = np.vectorize(lambda n: _rate(chain, n), otypes=[np.float64])(single)
        margins[P_HOUR] = np.where(bursts < 0, 1.0, -np.expm1(-rate * _HOUR / ts))
    return replace(found, margins=margins)


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
