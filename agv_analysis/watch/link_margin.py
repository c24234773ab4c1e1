"""What the losses seen so far say of the loop: stable or not, how surely, and which outages it survives."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.scenario import Scenario, parse_scenario
from agv_analysis.stability.confidence.link_confidence import link_confidence
from agv_analysis.stability.criteria.any_outages import largest_n, longest_for
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.scenario_loop import loop_on_lap
from agv_analysis.stability.verdict import SURE
from agv_ros.errors import UserError

UNDECIDED, STABLE, UNSTABLE, NOT_COVERED = "Undecided", "Stable", "Unstable", "Not covered"


class LinkMargin(NamedTuple):
    """An answer of `link_margin`."""

    word: str
    reason: str
    probability_stable: float | None = None
    growth: float | None = None
    """Of the mean square of small errors, logarithm per step."""
    guaranteed: float | None = None
    """Outages up to this length [slots] are survived in any order; inf: any are, None: not known."""
    slots: int = 0
    """Slots that were judged."""


def link_margin(params: str, k: NDArray[np.int64], lost: NDArray[np.bool_], not_covered: str) -> LinkMargin:
    """Judge the loop of a params file's text by the outcomes `lost` of its uplink's slots `k`, increasing, shape (N,).

    `not_covered` says why the links are none that this covers; empty if they are.
    """
    try:
        scenario, guaranteed = _of_loop(params)
    except NoNominalMotionError as error:
        return LinkMargin(UNSTABLE, f"it does not settle even without losses: {error}", slots=len(k))
    except UserError as error:
        return LinkMargin(NOT_COVERED, str(error), slots=len(k))
    if not_covered:
        return LinkMargin(NOT_COVERED, not_covered, slots=len(k))
    if not len(k):
        return LinkMargin(UNDECIDED, "nothing was seen of the link yet", guaranteed=guaranteed)
    found = link_confidence(loop_on_lap(scenario), k, lost, scenario.plant.ts)
    sure = found.probability_stable
    word = STABLE if sure >= SURE else UNSTABLE if sure <= 1.0 - SURE else UNDECIDED
    return LinkMargin(word, found.reason, sure, found.growth, guaranteed, len(k))


@functools.lru_cache(maxsize=8)
def _of_loop(params: str) -> tuple[Scenario, float]:
    """The scenario, and the longest outages that its loop survives in any order; inf: any. Raises UserError."""
    scenario = parse_scenario(params, "the loop's parameters")
    loop = loop_on_lap(scenario)
    guaranteed, _ = largest_n(loop, longest_for(loop))
    return scenario, math.inf if guaranteed is None else guaranteed
