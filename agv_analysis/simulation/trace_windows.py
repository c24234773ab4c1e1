"""Parts of a long measured link as what the seeds of many runs meet: else all of them were one run, told many times."""

from __future__ import annotations

import math
from dataclasses import replace

from agv_analysis.scenario import Scenario
from agv_plant.channels.registry import TRACE
from agv_plant.channels.timed_trace import read_trace
from agv_plant.parameters import ChannelParameters

_LINKS = ("uplink", "downlink")


def with_windows(scenario: Scenario, seconds: float | None = None) -> Scenario:
    """The scenario with seeds that meet other parts of its traces with times, where these last for two runs at least.

    A run lasts `seconds`, by default as long as the scenario says; one without an end meets all of a trace. A
    `trace_window` that is set stays.
    """
    length, relay = scenario.plant.duration if seconds is None else seconds, scenario.relay
    up, down = (_windowed(scenario, link, length) for link in _LINKS)
    is_same = up is relay.uplink and down is relay.downlink
    return scenario if is_same else replace(scenario, relay=replace(relay, uplink=up, downlink=down))


def _windowed(scenario: Scenario, link: str, seconds: float) -> ChannelParameters:
    channel: ChannelParameters = getattr(scenario.relay, link)
    if channel.model != TRACE or channel.trace_window > 0.0 or not math.isfinite(seconds):
        return channel
    trace = read_trace(channel.trace_file, link)
    is_longer = trace.time is not None and trace.length(scenario.plant.ts) >= 2.0 * seconds
    return replace(channel, trace_window=seconds) if is_longer else channel


def parts_of_traces(scenario: Scenario) -> int:
    """How many different parts of its traces the seeds meet; 1: all meet the same."""
    parts = 1
    for link in _LINKS:
        channel: ChannelParameters = getattr(scenario.relay, link)
        if channel.model == TRACE and channel.trace_window > 0.0:
            length = read_trace(channel.trace_file, link).length(scenario.plant.ts)
            parts = max(parts, math.floor(length / channel.trace_window + 1e-9))
    return parts
