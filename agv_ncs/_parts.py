"""Parts of the loop by name: which there are, and how to add one for the running process.

A package adds parts for all processes by entry points. What is registered here is known to this process alone: neither
to nodes in processes of their own nor to the workers of a cluster.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.channels.model import Model
from agv_plant.channels.registry import CHANNELS
from agv_plant.vehicle.registry import VEHICLES


def control_laws() -> tuple[str, ...]:
    """Names for `controller.law`."""
    return CONTROL_LAWS.names()


def vehicles() -> tuple[str, ...]:
    """Names for `plant.vehicle`."""
    return VEHICLES.names()


def staleness_policies() -> tuple[str, ...]:
    """Names for `error_detector.policy`."""
    return STALENESS_POLICIES.names()


def channels() -> tuple[str, ...]:
    """Names for `relay.uplink.model` and `relay.downlink.model`."""
    return CHANNELS.names()


def register_control_law(name: str, law: Callable[..., Any]) -> None:
    """Add a control law for this process: (x_e, y_e, theta_e, v_r, w_r, gains ...) -> (v, w) [m, rad, m/s, rad/s].

    Each gain has a default, and is the parameter `controller.<name>.<gain>` from then on. A name may be registered
    again, with another function of the same gains. Raises UserError for a name that is taken or a signature that the
    loop cannot call.
    """
    CONTROL_LAWS.register(name, law)


def register_vehicle(name: str, vehicle: Callable[..., Any]) -> None:
    """Add a vehicle for this process: (x, y, theta, states ..., v, w, dt, parameters ...) -> (x, y, theta, states ...).

    Otherwise as `register_control_law`; parameters are called `plant.<name>.<parameter>`.
    """
    VEHICLES.register(name, vehicle)


def register_staleness_policy(name: str, policy: Callable[..., Any]) -> None:
    """Add a staleness policy for this process: (held, target, reference, parameters ...) -> (held, target), as poses.

    Otherwise as `register_control_law`; parameters are called `error_detector.<name>.<parameter>`.
    """
    STALENESS_POLICIES.register(name, policy)


def register_channel(name: str, model: Model) -> None:
    """Add a channel model for this process: (channel, k, u, state) -> (lost, state).

    `channel` has the parameters of the link, `channel.arguments` those of the model; u are four numbers of slot k that
    are uniform in [0, 1). Raises UserError for a name that is taken or if the model is not a function.
    """
    CHANNELS.register(name, model)
