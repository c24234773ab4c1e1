"""One run of the loop as arrays: the same type from a recorded bag and from the simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
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
class Timing:
    """When the messages of a run in real time came, from their log times, and what its nodes say of their deadlines."""

    is_late: bool
    """Were poses or commands that acted older than losses explain, by more than jitter? See docs/bags.md."""
    command_age: NDArray[np.int64]
    """Steps since the pose behind the command that acted at step k, by stamps or by receive time, whichever is more;
    shape (N,)."""
    late_poses: int = 0
    """Poses that came one sampling period or more too late."""
    late_commands: int = 0
    """Commands that came after the step that they were for had ended."""
    deadlines: int | None = None
    """Steps that the plant had to take in time; None if its diagnostics are not recorded, as are the next ones."""
    missed_deadlines: int | None = None
    longest_overdue: float | None = None
    """Most by which a tick of the plant was later after the one before it than T_s [s]."""
    missed_edge_steps: int | None = None
    """Steps that an edge with its own clock did not take."""
    unknown: str = ""
    """Why log times do not say when messages came; empty if they do."""
    sentences: tuple[str, ...] = ()
    """All of this in words, as it is in the notes of the run."""

    def to_json(self) -> dict[str, int | float | bool | str | None]:
        """The figures by name; SI units."""
        return {
            "late": None if self.unknown else self.is_late,
            "command_age_max": int(self.command_age.max()),
            "late_poses": None if self.unknown else self.late_poses,
            "late_commands": None if self.unknown else self.late_commands,
            "deadlines": self.deadlines,
            "missed_deadlines": self.missed_deadlines,
            "longest_overdue": self.longest_overdue,
            "missed_edge_steps": self.missed_edge_steps,
            "unknown_because": self.unknown or None,
        }


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
    n_ul_received: NDArray[np.int64] | None = None
    """Steps since the freshest pose that had come to the edge when step k ended, shape (N,); None if log times do not
    say it, as of a run in lockstep."""
    n_dl_received: NDArray[np.int64] | None = None
    """Steps since the freshest command that had come to the AGV was sent, likewise; of another robot the steps by which
    the command that had come is behind the newest that was sent."""
    timing: Timing | None = None
    """None for a simulated run and one in lockstep, which have no timing of their own."""

    @property
    def sent_pose(self) -> Floats:
        """What the AGV sent of its pose, shape (N, 3): all that the edge can know."""
        return self.pose if self.measured is None else self.measured

    @property
    def command_age(self) -> NDArray[np.int64]:
        """Steps since the pose behind the command that acted at step k, shape (N,): what to judge a run by.

        It is `n_ul`, but where the timing of a run was not what its slots say.
        """
        return self.n_ul if self.timing is None or not self.timing.is_late else self.timing.command_age

    @property
    def acting_age(self) -> NDArray[np.int64]:
        """Steps since the pose behind the command that the plant holds at step k, shape (N,).

        The age of the command and that of the pose when the command was computed; `command_age` where a run does not
        say how old commands were, or its timing was not what its slots say.
        """
        if self.n_dl is None or self.is_late:
            return self.command_age
        sent = np.maximum(np.arange(len(self)) - self.n_dl, 0)
        return np.asarray(self.n_dl + self.n_ul[sent])

    @property
    def is_late(self) -> bool:
        """Were poses or commands older than the slots say, by receive time?"""
        return self.timing is not None and self.timing.is_late

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

    def part(self, rows: slice) -> Run:
        """The run over some of its steps."""
        found: Run = _rows_of(self, len(self), rows)
        return found


def _rows_of(value: Any, steps: int, rows: slice) -> Any:
    """A dataclass with those rows of each array of it that has a row a step."""
    found: dict[str, Any] = {}
    for field_ in fields(value):
        inner = getattr(value, field_.name)
        if isinstance(inner, np.ndarray) and len(inner) == steps:
            found[field_.name] = inner[rows]
        elif isinstance(inner, (LinkSlots, Timing)):
            found[field_.name] = _rows_of(inner, steps, rows)
    return replace(value, **found)
