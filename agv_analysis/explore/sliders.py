"""What can be moved on the explorer's page: sliders, and lists to choose from, of all parts that are installed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from agv_analysis.scenario import PART_CHOICES, SCHEMAS
from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_cloud.reference.tracks import TRACKS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.channels.registry import CHANNELS, MODELS
from agv_plant.vehicle.registry import VEHICLES
from agv_ros.parameters import Parameter, parameters_of

_LOG_STEPS, _LOG_REACH = 300, 1000.0
"""Steps of a logarithmic slider, and how many times its smallest value the largest is: 2.3 % a step."""


@dataclass(frozen=True)
class Slider:
    """One slider: what it is called, which values it takes, what it sets."""

    key: str
    label: str
    low: float
    high: float
    step: float
    target: str = ""
    """The parameter, as in `controller.kx`; empty if the value goes into several."""
    scale: float = 1.0
    """What the parameter is multiplied with to be shown: 1000 where it is in seconds and shown in milliseconds."""
    open_end: bool = False
    """Is there no limit at the high end?"""
    is_log: bool = False
    """Does each step multiply the value? The lowest position stands for the low end all the same, which may be 0."""

    @property
    def positions(self) -> tuple[float, float, float]:
        """First and last position of the handle, and its step."""
        return (0.0, float(_LOG_STEPS), 1.0) if self.is_log else (self.low, self.high, self.step)

    def value_at(self, position: float) -> float:
        """The value of a position, of a logarithmic slider in three digits."""
        if not self.is_log:
            return position
        if position <= 0.0:
            return self.low
        return float(f"{self._smallest * (self.high / self._smallest) ** (position / _LOG_STEPS):.3g}")

    def position_of(self, value: float) -> float:
        """Where the handle stands for a value."""
        if not self.is_log:
            return value
        if value <= self._smallest:
            return 0.0
        share = math.log(value / self._smallest) / math.log(self.high / self._smallest)
        return round(_LOG_STEPS * min(1.0, share), 3)

    @property
    def _smallest(self) -> float:
        return max(self.low, self.high / _LOG_REACH)


NO_LIMIT = 20.0
"""At this end of its slider v_max, or another limit, is none."""

_STEPS = 100
"""Steps of a slider that is made for a gain, about."""


def gain_slider(key: str, target: str, name: str, known: Parameter) -> Slider:
    """A slider for a parameter, from its bounds and its default: as far as four times that."""
    unlimited = known.default == math.inf
    reach = NO_LIMIT if unlimited else 4.0 * known.default
    low_bound = known.low if known.low is not None else known.above
    low = max(min(reach, 0.0), -math.inf if low_bound is None else low_bound)
    high = min(max(reach, 0.0), math.inf if known.high is None else known.high)
    if high <= low:  # the default is 0
        high = low + min(1.0, math.inf if known.high is None else known.high - low)
    step = _round_step((high - low) / _STEPS)
    unit = f" [{known.unit}]" if known.unit else ""
    label = f"{name}{unit}, {high:g}: none" if unlimited else f"{name}{unit}"
    first, is_log = low + step if low == known.above else low, low >= 0.0 and not unlimited
    return Slider(key, label, first, high, step, target, open_end=unlimited, is_log=is_log)


def _round_step(about: float) -> float:
    """A step of 1, 2 or 5 times a power of ten."""
    power = math.floor(math.log10(about))
    factor = next(factor for factor in (1, 2, 5, 10) if about <= factor * 10.0**power * (1.0 + 1e-9))
    return float(f"{factor}e{power}")


def _gain_sliders(law: str) -> tuple[Slider, ...]:
    known = parameters_of(SCHEMAS["controller"])
    found = [(name, known[name]) for name in PART_CHOICES["controller"].names(law) if name in known]
    return tuple(
        gain_slider(name.replace(".", "-"), f"controller.{name}", name.removeprefix(f"{law}."), parameter)
        for name, parameter in found
    )


GAIN_SLIDERS: dict[str, tuple[Slider, ...]] = {
    KANAYAMA: (
        Slider("kx", "K_x [1/s]", 0.0, 400.0, 1.0, "controller.kx", is_log=True),
        Slider("ky", "K_y [1/m^2]", 0.0, 20.0, 0.1, "controller.ky", is_log=True),
        Slider("ktheta", "K_theta [1/m]", 0.0, 20.0, 0.1, "controller.ktheta", is_log=True),
    ),
    **{law: _gain_sliders(law) for law in CONTROL_LAWS.usable() if law != KANAYAMA},
}
"""Sliders by the control law whose gains they are."""

LOOK_AHEAD = Slider("look_ahead", "look ahead [ms]", 10.0, 2000.0, 10.0, "controller.look_ahead", 1e3)
"""Shown for control laws that look ahead."""

LOOKING_AHEAD = tuple(name for name, law in CONTROL_LAWS.usable().items() if "look_ahead" in law.arguments)

USUAL_LOOK_AHEAD = 500.0
"""Where the slider stands [ms] if the params file looks ahead by nothing."""

OTHER_SLIDERS = (
    Slider("ts", "T_s [ms]", 1.0, 50.0, 1.0, "plant.ts", 1e3),
    Slider("v_max", f"v_max [m/s], {NO_LIMIT:g}: none", 0.5, NO_LIMIT, 0.5, "controller.v_max", open_end=True),
    Slider("ahead", "starts ahead by [m]", -10.0, 10.0, 0.5),
    Slider("left", "starts to the left by [m]", -5.0, 5.0, 0.1),
    Slider("p", "channel: p", 0.0, 1.0, 0.005, "relay.uplink.p"),
    Slider("r", "channel: r", 0.0, 1.0, 0.01, "relay.uplink.r"),
    Slider("n", "burst: n lost after each received", 0.0, 60.0, 1.0, "relay.uplink.n"),
    Slider("delay", "delay of each pose [ms]", 0.0, 500.0, 1.0, "relay.uplink.delay", 1e3),
    Slider("seed", "seed of the outages", 1.0, 100.0, 1.0, "relay.seed"),
)

SLIDERS = (*(slider for sliders in GAIN_SLIDERS.values() for slider in sliders), LOOK_AHEAD, *OTHER_SLIDERS)
"""All sliders."""


@dataclass(frozen=True)
class Choice:
    """A drop-down list: what it is called, what there is to choose from, what it sets."""

    label: str
    names: tuple[str, ...]
    target: str


_OF_OTHERS = tuple(name for name in CHANNELS.names() if name not in (*CHANNELS.own, *CHANNELS.reserved))

CHOICES = {
    "law": Choice("control law", CONTROL_LAWS.names(), "controller.law"),
    "vehicle": Choice("vehicle", VEHICLES.names(), "plant.vehicle"),
    "model": Choice("channel", (*MODELS, *_OF_OTHERS), "relay.uplink.model"),
    "policy": Choice("policy", STALENESS_POLICIES.names(), "error_detector.policy"),
    "track": Choice("track", tuple(TRACKS), "error_detector.track"),
}
"""Drop-down lists by key."""
