"""Parameters of the AGV's side: plant and relay."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

from agv_plant.channels.coverage_hole import NO_HOLES
from agv_plant.channels.coverage_hole import rows_of as holes
from agv_plant.channels.position_dependent import EVERYWHERE, kind_of
from agv_plant.channels.registry import CHANNELS, SHARED, TRACE
from agv_plant.channels.timed_trace import has_delays
from agv_plant.channels.trace import ENDS
from agv_plant.downlink_policy import DOWNLINK_POLICIES
from agv_plant.radio.schedule import Entry, parse_schedule
from agv_plant.radio.shared_uplink import SCHEDULERS
from agv_plant.vehicle.registry import UNICYCLE, VEHICLES
from agv_plant.vehicle.unicycle import STEPS
from agv_ros.message_types import COMMAND_TYPES, POSE_TYPES, TWIST
from agv_ros.parameters import LoopParameters, ParameterError, TwoDomains, group, merged, parameter, parameters_of
from agv_ros.part_parameters import refuse_taken, schema_of, values_of
from agv_ros.parts import try_part


@dataclass(frozen=True)
class _OwnPlantParameters(LoopParameters):
    """Parameters of the node `plant` but for those of vehicles."""

    initial_pose: tuple[float, float, float] = parameter(
        (0.0, 5.0, 1.5707963267948966), "X_c(0) = [x, y, theta] in frame map", unit="m, m, rad"
    )
    vehicle: str = parameter(
        UNICYCLE,
        "vehicle; unicycle: turns as commanded, the paper's, bicycle: steers its front wheel; what vehicles have of "
        "their own has their name before it",
        choices=VEHICLES.names,
        remedy=VEHICLES.remedy,
    )
    integration: str = parameter("euler", "how the plant integrates one period", choices=tuple(STEPS))
    clock: str = parameter(
        "lockstep",
        "lockstep: step k+1 follows the answer to step k, as fast as it comes; realtime: one step every ts",
        choices=("lockstep", "realtime"),
    )
    duration: float = parameter(
        100.0, "length of the run, .inf: until stopped; it cuts the track short, it does not rescale it", unit="s",
        above=0.0, high=math.inf,
    )  # fmt: skip
    answer_timeout: float = parameter(
        5.0, "lockstep: how long to wait for the answer to a step before giving up", unit="s", above=0.0, high=3600.0
    )
    start_timeout: float = parameter(
        300.0, "how long to wait for the other nodes before giving up", unit="s", above=0.0, high=1e6,
    )  # fmt: skip
    cmd_vel_timeout: float = parameter(
        0.5, "realtime: the AGV stops when its newest command is older than this", unit="s", above=0.0, high=3600.0
    )
    downlink_policy: str = parameter(
        "hold",
        "what the AGV does in a step whose command did not arrive; hold: it follows the newest one, zero: it stands "
        "still, ramp: it slows down to a stand within ramp_time, buffer: it drives what was planned plan_steps ahead, "
        "then it stands still",
        choices=DOWNLINK_POLICIES,
    )
    ramp_time: float = parameter(0.2, "ramp: time from the newest command to a stand", unit="s", above=0.0, high=3600.0)
    speed_scale: float = parameter(
        1.0, "true speed over commanded speed: a worn or badly measured wheel", above=0.0, high=10.0
    )
    w_max: float = parameter(math.inf, "limit on |w|, .inf: none", unit="rad/s", above=0.0, high=math.inf)
    a_max: float = parameter(math.inf, "limit on |dv/dt|, .inf: none", unit="m/s^2", above=0.0, high=math.inf)
    j_max: float = parameter(math.inf, "limit on |d2v/dt2|, .inf: none", unit="m/s^3", above=0.0, high=math.inf)
    lag: float = parameter(
        0.0, "time constant with which the drive follows a command; 0: at once", unit="s", low=0.0, high=60.0
    )
    slip: float = parameter(
        0.0, "slip ratio of the wheels: share of a wheel's speed that is lost to the ground", low=-1.0, high=1.0
    )
    slip_noise: float = parameter(
        0.0, "standard deviation of the slip ratio, drawn in each step for each of the two wheels", low=0.0,
        high=1.0,
    )  # fmt: skip
    track_width: float = parameter(0.5, "distance between the wheels, if they slip", unit="m", above=0.0, high=100.0)
    skid: float = parameter(
        0.0, "outward side-slip angle over lateral acceleration v w: mass over cornering stiffness", unit="s^2/m",
        low=0.0, high=1.0,
    )  # fmt: skip
    substeps: int = parameter(
        1, "equal parts in which a period is integrated, each with the speed that the drive has by then", low=1,
        high=1000,
    )  # fmt: skip
    noise_xy: float = parameter(
        0.0, "standard deviation of x and of y in agv/pose; the true pose is then on agv/ground_truth", unit="m",
        low=0.0, high=100.0,
    )  # fmt: skip
    noise_theta: float = parameter(0.0, "the same of theta", unit="rad", low=0.0, high=10.0)
    seed: int = parameter(
        1, "seed of noise and slip; a sweep's seeds, and agv-ncs run --seed, set it with relay.seed", low=0, high=2**62
    )


_TAKEN = tuple(parameters_of(_OwnPlantParameters))


def _vehicle_parameters() -> type:
    return schema_of("ParametersOfVehicles", VEHICLES.usable(), _TAKEN, globals())


@dataclass(frozen=True)
class PlantParameters(_OwnPlantParameters):
    """Parameters of the node `plant`."""

    of_vehicles: Any = merged(_vehicle_parameters, VEHICLES.refusal)
    """Parameters of vehicles that have some, `vehicle.parameter`."""

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        vehicle = VEHICLES.find(self.vehicle)
        refuse_taken(vehicle, _TAKEN)
        for x, y, theta, v, w in _TRIALS:
            states = (0.0,) * len(vehicle.states)
            arc = self.integration == "arc"
            try_part(vehicle, VEHICLES.call, x, y, theta, states, v, w, v, w, self.ts, arc, self.vehicle_values)
        if self.downlink_policy == "buffer" and self.plan_steps == 0:
            raise ParameterError("plant.downlink_policy is buffer, but plan_steps is 0: set it, the same on all nodes")

    @property
    def vehicle_values(self) -> tuple[float, ...]:
        """The parameters of the chosen vehicle, in the order of its signature."""
        return values_of(VEHICLES.find(self.vehicle), self.of_vehicles)

    @property
    def policy_steps(self) -> float:
        """Steps until the downlink policy lets the AGV stand, where it has such a number."""
        return self.plan_steps if self.downlink_policy == "buffer" else self.ramp_time / self.ts

    @property
    def is_noisy(self) -> bool:
        """Does the AGV measure another pose than its true one?"""
        return self.noise_xy > 0.0 or self.noise_theta > 0.0


_TRIALS = ((0.0, 0.0, 0.5, 1.0, 0.1), (1.0, -2.0, 3.0, 0.0, 0.0))
"""Poses in frame `map` [m, m, rad] and speeds [m/s, rad/s] that a vehicle must handle."""


@dataclass(frozen=True)
class ChannelParameters:
    """One direction of the radio channel."""

    model: str = parameter("perfect", "channel model", choices=CHANNELS.names, remedy=CHANNELS.remedy)
    p: float = parameter(
        0.0,
        "bernoulli: loss probability; coverage_hole: the same outside of the holes; gilbert_elliott: probability of "
        "good to bad, per slot; shared: loss probability of a pose that is sent",
        low=0.0,
        high=1.0,
        runtime=True,
    )
    r: float = parameter(1.0, "gilbert_elliott: probability of bad to good, per slot", low=0.0, high=1.0, runtime=True)
    h: float = parameter(
        0.0, "gilbert_elliott: probability of delivery in the bad state", low=0.0, high=1.0, runtime=True
    )
    k: float = parameter(
        1.0, "gilbert_elliott: probability of delivery in the good state", low=0.0, high=1.0, runtime=True
    )
    n: int = parameter(0, "burst: number of consecutive slots lost", low=0, high=1_000_000, runtime=True)
    start_step: int = parameter(
        -1, "burst: the one step from which n slots are lost; -1: n are lost after each received one", low=-1,
        high=2**62, runtime=True,
    )  # fmt: skip
    hole_loss: float = parameter(
        1.0, "coverage_hole: loss probability inside of a hole", low=0.0, high=1.0, runtime=True
    )
    hole_circles: tuple[float, ...] = parameter(
        NO_HOLES, "coverage_hole: x, y, radius of each round hole, in frame map; [0.0]: none", unit="m", any_length=True
    )
    hole_polygons: tuple[float, ...] = parameter(
        NO_HOLES,
        "coverage_hole: x, y of the corners of each other hole, in frame map, its first corner again at its end; "
        "[0.0]: none",
        unit="m",
        any_length=True,
    )
    carrier: float = parameter(3.7e9, "rayleigh: carrier frequency", unit="Hz", low=1e6, high=1e12)
    margin: float = parameter(
        20.0, "rayleigh: fade margin; lost where the gain is more than this below its mean", unit="dB", low=-100.0,
        high=300.0, runtime=True,
    )  # fmt: skip
    vehicles: int = parameter(1, "shared: number of AGVs that share the link", low=1, high=1000)
    vehicle: int = parameter(
        0, "which AGV of a fleet this one is, from 0 on; each has random numbers of its own", low=0, high=999
    )
    blocks: int = parameter(1, "shared: how many of them may send in a slot", low=1, high=1000)
    scheduler: str = parameter(
        SCHEDULERS[0],
        "shared: who may; in turn, those whose pose is the oldest at the edge, or any",
        choices=SCHEDULERS,
    )
    trace_file: str = parameter(
        "",
        "trace: CSV file with a column lost (0, 1) or verdict (delivered, lost), or uplink_lost and downlink_lost; "
        "with a column time [s] it is played by time, and may have delays [s], else a row is a slot; or JSON with "
        "lists so called",
    )
    trace_end: str = parameter(
        "repeat",
        "trace: what follows its last slot; repeat: the first, hold: no more losses, stop: an error",
        choices=ENDS,
    )
    trace_window: float = parameter(
        0.0,
        "trace: a run with seed s begins s - 1 times this behind the trace's beginning, so that seeds meet different "
        "parts of a long one; 0: all begin with it",
        unit="s",
        low=0.0,
        high=1e9,
    )
    correlation: float = parameter(
        0.0,
        "downlink: share of slots in which it draws the uplink's random numbers; rayleigh: correlation of the two "
        "links' complex gains; 1: identical",
        low=0.0,
        high=1.0,
    )
    delay: float = parameter(
        0.0, "time under way of a message that is not lost, rounded up to whole slots", unit="s", low=0.0, high=60.0,
        runtime=True,
    )  # fmt: skip
    jitter: float = parameter(
        0.0, "the delay is uniform in delay +- jitter; beyond ts, messages overtake each other", unit="s", low=0.0,
        high=60.0, runtime=True,
    )  # fmt: skip
    duplicate: float = parameter(
        0.0, "probability that a message comes a second time, with a delay of its own", low=0.0, high=1.0, runtime=True
    )
    lifetime: float = parameter(
        math.inf, "a message that would come older than this never comes, .inf: all come", unit="s", above=0.0,
        high=math.inf, runtime=True,
    )  # fmt: skip
    reliable: bool = parameter(
        False,
        "true: as reliable DDS, which sends again what was lost and keeps the order: losses become late bursts",
    )
    resend_after: float = parameter(
        0.01,
        "reliable: time from the first message that comes through after an outage until the missing ones have come",
        unit="s", low=0.0, high=10.0,
    )  # fmt: skip
    history: int = parameter(
        0, "reliable: how many messages the sender keeps; older ones of an outage are lost for good; 0: all of them",
        low=0, high=4096,
    )  # fmt: skip
    schedule: str = parameter(
        "",
        "what changes in a run, as in '20: p=0.1; 20: outage=0.3 every 5; 60: outage=0': from 20 s on p is 0.1 and all "
        "is lost for 0.3 s every 5 s, from 60 s on no more; takes any number that changes at run time",
        runtime=True,
    )
    arguments: tuple[float, ...] = parameter(
        (0.0,), "a model of another package: whatever numbers it takes", any_length=True, runtime=True
    )

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        if self.model == TRACE and not self.trace_file:
            raise ParameterError("a channel's model is trace, but its trace_file is empty: name a file")
        if not holes(self.hole_circles, self.hole_polygons) and self.model == "coverage_hole":
            raise ParameterError(
                "a channel's model is coverage_hole, but neither hole_circles nor hole_polygons has one"
            )
        if self.model == SHARED and self.vehicle >= self.vehicles:
            raise ParameterError(
                f"a channel's vehicle is {self.vehicle}, must be 0 to {self.vehicles - 1}: see vehicles"
            )
        if self.reliable:
            self._refuse_with_reliable()
        _ = self.entries

    def _refuse_with_reliable(self) -> None:
        """Raise ParameterError for what cannot be, where all comes once and in order, or cannot be known ahead."""
        if self.jitter > 0.0 or self.duplicate > 0.0 or any(e.name in ("jitter", "duplicate") for e in self.entries):
            raise ParameterError("a channel is reliable, so all comes once and in order: set jitter and duplicate to 0")
        if self.is_placed:
            raise ParameterError(
                f"a channel is reliable, and its model {self.model} asks where the AGV is when it sends again, which "
                "cannot be known: choose another model"
            )
        if self.model == TRACE and has_delays(self.trace_file):
            raise ParameterError("a channel is reliable, but its trace has delays already: set reliable to false")

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The schedule, by time."""
        return _entries(self.schedule)

    @property
    def is_direct(self) -> bool:
        """Are losses independent of the AGV's place, and does every other message arrive in its own slot?"""
        return not (self.is_placed or self.delays)

    @property
    def is_placed(self) -> bool:
        """Does what is lost depend on where the AGV is?"""
        return kind_of(self.model) != EVERYWHERE

    @property
    def delays(self) -> bool:
        """May a message arrive later than in its slot? Raises TraceError for a trace that cannot be read."""
        of_parameters = self.delay + self.jitter > 0.0
        of_schedule = any(entry.name in ("delay", "jitter") for entry in self.entries)
        of_trace = self.model == TRACE and has_delays(self.trace_file)
        return self.reliable or of_parameters or of_schedule or of_trace


@dataclass(frozen=True)
class RelayParameters(TwoDomains):
    """Parameters of the node `relay`."""

    uplink: ChannelParameters = group(ChannelParameters)
    downlink: ChannelParameters = group(ChannelParameters)
    seed: int = parameter(1, "seed of all random outcomes of the channel", low=0, high=2**62)
    pose_type: str = parameter(
        "pose",
        "type of agv/pose and edge/pose; pose: geometry_msgs/PoseStamped, odometry: nav_msgs/Odometry",
        choices=POSE_TYPES,
    )
    command_type: str = parameter(
        "twist_stamped",
        "type of agv/cmd_vel; twist_stamped: geometry_msgs/TwistStamped, as edge/cmd_vel, twist: geometry_msgs/Twist",
        choices=COMMAND_TYPES,
    )
    stamps: str = parameter(
        "grid",
        "what stamps may be; grid: sampling instants, others are refused, any: each means the nearest step since "
        "the first, as of a robot with a clock of its own",
        choices=("grid", "any"),
    )

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        if self.command_type == TWIST and self.plan_steps:
            raise ParameterError(
                "relay.command_type is twist, but plan_steps is not 0: a plan is not a geometry_msgs/Twist"
            )


_CHANGEABLE = {
    name: found
    for name, found in parameters_of(ChannelParameters).items()
    if found.runtime and found.kind in ("double", "integer")
}
"""What a schedule may change."""


@functools.lru_cache(maxsize=256)
def _entries(schedule: str) -> tuple[Entry, ...]:
    return parse_schedule(schedule, _CHANGEABLE) if schedule else ()
