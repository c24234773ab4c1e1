"""An outage that is asked for while the loop runs: the relay's schedule with one more entry."""

from __future__ import annotations

from agv_plant.parameters import ChannelParameters
from agv_plant.radio.schedule import OUTAGE
from agv_ros.parameters import ParameterError


def with_outage(uplink: ChannelParameters, begin: int, slots: int, ts: float) -> str:
    """The schedule of a link that loses everything in the slots begin .. begin + slots - 1, too.

    Raises ParameterError where the schedule has outages that come again, which this one would end.
    """
    if any(entry.name == OUTAGE and entry.outage.period > 0.0 for entry in uplink.entries):
        raise ParameterError(
            f"relay.uplink.schedule has outages that come again, which another one would end: {uplink.schedule!r}"
        )
    entry = f"{begin * ts:.9g}: {OUTAGE}={slots * ts:.9g}"
    return f"{uplink.schedule}; {entry}" if uplink.schedule.strip() else entry
