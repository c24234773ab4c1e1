"""One run of the loop as arrays: the same type from a recorded bag and from the simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.scenario import Scenario

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LinkSlots:
    """Why one direction of the radio did what it did to the messages of N slots."""

    cause: NDArray[np.str_]
    """Of a loss: the channel's model, or `outage` if its schedule says so; empty where nothing is lost; shape (N,)."""
    state: NDArray[np.int64]
    """State of a channel with memory that decided, shape (N,)."""
    gain: Floats
    """The channel's gain [dB] over its mean, shape (N,); NaN where it has none."""
    delay: NDArray[np.int64]
    """Slots that the message is under way, 0 if it comes in its own slot or not at all, shape (N,)."""


@dataclass(frozen=True)
class ParameterChange:
    """A parameter of a node of the loop that was changed while the loop ran."""

    k: int
    """First step with the new value."""
    node: str
    """As in Scenario: plant, relay, error_detector, controller."""
    name: str
    old: Any
    new: Any


@dataclass(frozen=True)
class Run:
    """A run of N steps, row i of every array belonging to step k[i]; SI units, frame `map` unless said otherwise."""

    scenario: Scenario
    k: NDArray[np.int64]
    """Steps, shape (N,), increasing; without gaps unless messages are missing."""
    pose: Floats
    """X_c(k) = x, y, theta of the AGV, shape (N, 3); theta counts turns. The true one, if the run knows it."""
    reference: Floats
    """X_r(k) and its speeds: x, y, theta, v_r, w_r, shape (N, 5); theta counts turns."""
    error: Floats
    """eps(k) as the edge computed it: x_e, y_e, theta_e in the AGV's frame, shape (N, 3); NaN where none was sent."""
    command: Floats
    """u(k) = v, w as the controller sent it, shape (N, 2); NaN where none was sent."""
    n_ul: NDArray[np.int64]
    """Steps since the freshest pose that the edge holds, shape (N,)."""
    lost: NDArray[np.bool_]
    """Outcome of the uplink on slot k, shape (N,)."""
    downlink_lost: NDArray[np.bool_]
    """Outcome of the downlink on slot k, shape (N,)."""
    n_dl: NDArray[np.int64] | None = None
    """Steps since the freshest command that the AGV holds was sent, shape (N,); None if it is not recorded."""
    uplink: LinkSlots | None = None
    """What is known of the uplink's slots beside their outcomes; None if nothing is."""
    downlink: LinkSlots | None = None
    source: str = "simulation"
    """Where the run comes from: the path of its bag, or `simulation`."""
    unexplained: Mapping[str, int] = field(default_factory=dict)
    """Messages by topic that are missing although no channel lost them; with any of them the run proves nothing."""
    notes: tuple[str, ...] = ()
    """What a reader must know of the recording: damage, repeated steps, parameters that do not fit."""
    measured: Floats | None = None
    """The poses that the AGV measured and sent, shape (N, 3), where they are not the true ones; see `sent_pose`."""
    error_speeds: Floats | None = None
    """v_r, w_r as the edge sent them with each error, shape (N, 2); None: those of the reference compared with."""
    parameter_changes: tuple[ParameterChange, ...] = ()
    """Parameters that were changed while the run went on, by step; `scenario` has the values that it began with."""
    gains_known: bool = True
    """Are the gains and limits in `scenario.controller` those of the run? Else they mean nothing."""
    seed_known: bool = True
    """Were the losses drawn from `scenario.relay.seed`? Those of a real radio come from none."""

    @property
    def sent_pose(self) -> Floats:
        """What the AGV sent of its pose, shape (N, 3): all that the edge can know."""
        return self.pose if self.measured is None else self.measured

    @property
    def ts(self) -> float:
        """Sampling period T_s [s]."""
        return self.scenario.plant.ts

    @property
    def time(self) -> Floats:
        """Time since step 0 [s], shape (N,)."""
        return np.asarray(self.k * self.ts, dtype=np.float64)

    def __len__(self) -> int:
        return len(self.k)
