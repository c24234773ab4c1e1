"""A scenario's loop that is driven lap after lap, and excursions from its loss-free motion."""

from __future__ import annotations

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import numbers
from agv_analysis.corridor.excursions import COLUMNS, Plan, excursions
from agv_analysis.corridor.shares import along_and_across, path_shares, shares_of
from agv_analysis.corridor.widths import Widths
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.batch import cores
from agv_analysis.simulation.loop import Loop, RunInputs, history
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.reference import repeated
from agv_analysis.simulation.single import settings_of, start_of
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import lap_of, loop_on_lap
from agv_ros.pose import Pose

RECOVERY_SECONDS = 10.0
"""How long an excursion is driven on after its last loss, if it is not over before [s]."""

_PLACES = 500
"""Places of the lap from which it is asked what an outage does slot by slot."""

_AT_ONCE = 500
"""Excursions that are worth a thread of their own."""

Outcomes = NDArray[np.bool_]


class Excursions(NamedTuple):
    """Of the excursions that begin at some steps of the lap."""

    steps: NDArray[np.int64]
    """Steps of the lap, shape (S,)."""
    share: Floats
    """Largest share of the corridor that each uses, shape (S,)."""
    after: NDArray[np.int64]
    """Steps after its beginning at which it does."""
    along: Floats
    """Deviation there, along and across the track [m]."""
    across: Floats

    @property
    def worst(self) -> int:
        """Which of them uses the largest share."""
        return int(np.nanargmax(self.share))


class LapLoop:
    """The loop of a scenario on its track, driven again and again without noise or slip, its messages never late.

    Raises TrackFileError if the track's file cannot be used.
    """

    def __init__(self, scenario: Scenario, widths: Widths) -> None:
        self.scenario, self.widths = scenario, widths
        self.lap = lap_of(scenario)
        """X_r(k) and its speeds over one lap: x, y, theta, v_r, w_r, shape (N, 5)."""
        self.recovery = max(1, math.ceil(RECOVERY_SECONDS / self.ts))
        self._parts, self._settings = replacements_of(scenario), settings_of(scenario)
        self._reference = self.lap

    @property
    def ts(self) -> float:
        """Sampling period T_s [s]."""
        return self.scenario.plant.ts

    @property
    def steps(self) -> int:
        """N, steps of a lap."""
        return len(self.lap)

    def reference(self, steps: int) -> Floats:
        """The reference over so many steps, and as far beyond as the edge looks ahead, shape (steps or more, 5)."""
        wanted = steps + self.scenario.controller.steps_ahead
        if len(self._reference) < wanted:
            self._reference = repeated(self.lap, wanted, self.ts)
        return self._reference

    def start(self) -> Loop:
        """The loop before step 0 of a lap with its AGV on the reference, which need not be its loss-free motion."""
        return start_of(self.scenario, at=Pose(*self.lap[0, :3].tolist()))

    def inputs(self, lost: Outcomes) -> RunInputs:
        """A run from there under these outcomes of the uplink, without losses on the way back."""
        nothing = numbers(np.zeros(len(lost), dtype=np.bool_))
        return RunInputs(numbers(lost), nothing, self.start(), self._settings)

    def excursions(
        self, outcomes: Outcomes, every: int = 1, limit: float = math.inf,
        offsets: Floats | None = None, kept: int = 0, follow: bool = True, chosen: NDArray[np.bool_] | None = None,
    ) -> tuple[Excursions, Floats]:  # fmt: skip
        """Excursions under the same outcomes, True where lost, from every so many steps of a lap.

        Or only from those of them that are `chosen`, shape (S,); of the others the share is NaN.

        They end at `limit`, a share of the corridor, when they are over, or, if they are not to be followed, with the
        last outcome. The first outcome is a reception, after the last one all are. The AGVs are displaced by `offsets`,
        shape (S, 3), in their own frames [m, m, rad]. Also the errors x_e, y_e, theta_e [m, m, rad] before the first
        `kept` slots of each, shape (S, kept, 3).
        """
        lost = np.concatenate((outcomes, np.zeros(self.recovery if follow else 0, dtype=np.bool_)))
        shift = np.zeros((0, 3)) if offsets is None else offsets
        which = np.zeros(0, dtype=np.bool_) if chosen is None else chosen
        losses = int(np.flatnonzero(lost).max(initial=0)) if follow else len(lost)
        steps = np.arange(0, self.steps, every)
        found, paths = np.full((len(steps), COLUMNS), math.nan), np.full((len(steps), kept, 3), math.nan)
        reference = numbers(self.reference(self.steps + int(steps[-1]) + every + len(lost) + 1))

        def drive(part: NDArray[np.int64]) -> None:
            first = self.steps + int(steps[part[0]])  # after a lap the loop has settled
            plan, rows = Plan(first, every, losses, limit), slice(int(part[0]), int(part[-1]) + 1)
            run_parts(
                excursions, self._parts, reference, self.inputs(lost), self.widths, plan, numbers(shift[rows]),
                numbers(which[rows]), found[rows], paths[rows],
            )  # fmt: skip

        parts = np.array_split(np.arange(len(steps)), min(cores(), max(1, len(steps) // _AT_ONCE)))
        with ThreadPoolExecutor(len(parts)) as pool:
            list(pool.map(drive, parts))
        after = np.nan_to_num(found[:, 1]).astype(np.int64)
        return Excursions(steps, found[:, 0], after, found[:, 2], found[:, 3]), paths

    @functools.cached_property
    def linear(self) -> LinearLoop:
        """The loop to first order. Raises NoNominalMotionError if it does not settle even without losses."""
        return loop_on_lap(self.scenario)

    @functools.cached_property
    def loss_free_share(self) -> float:
        """Share of the corridor that the loop uses without any outage once it has settled; inf if it diverges."""
        reference, steps = self.reference(2 * self.steps), 2 * self.steps
        rows, n_ul = np.full((steps, 8), math.nan), np.empty(steps, dtype=np.int64)
        run_parts(
            history, self._parts, numbers(reference), self.inputs(np.zeros(steps, dtype=np.bool_)), rows, n_ul
        )  # fmt: skip
        return float(path_shares(rows[self.steps :, :3], reference[self.steps : steps], self.widths).max())

    def shares_in_outage(self, n: int) -> Floats:
        """Largest share of the corridor, from anywhere on the lap, after each loss of an outage, shape (n + 1,).

        Entry i is that after i losses.
        """
        _, paths = self.excursions(outage(n), max(1, self.steps // _PLACES), kept=n + 2)
        return np.asarray(np.nanmax(shares_of(*along_and_across(paths), self.widths), axis=0)[1:])


def outage(n: int) -> Outcomes:
    """Outcomes of a reception and the `n` losses after it."""
    return np.arange(n + 1) > 0
