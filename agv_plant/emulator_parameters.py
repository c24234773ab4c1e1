"""Parameters of the link emulator: two directions of the radio, and the topics that cross it."""

from __future__ import annotations

from dataclasses import dataclass

from agv_plant.parameters import ChannelParameters
from agv_ros.message_types import POSE_TYPES
from agv_ros.parameters import ParameterError, TwoDomains, group, parameter

PREFIXES = {"uplink": "edge", "downlink": "agv"}
"""What stands before a topic's name behind the radio, if nothing else is said."""

_ARROW = ":="


@dataclass(frozen=True)
class DirectionParameters(ChannelParameters):
    """One direction of the emulated radio: its channel, and what crosses it."""

    topics: tuple[str, ...] = parameter(
        ("",),
        'topics of any type that cross it, as [/scan, /odom]; "/scan:=/edge/scan", in quotes, also says what it is '
        'called on the other side; [""]: none',
    )
    prefix: str = parameter(
        "",
        "what stands before their names on the other side; empty: edge for the uplink, agv for the downlink, and "
        "nothing where each side has a domain of its own",
    )
    period: float = parameter(
        0.0, "length of a slot, in which all messages have one fate; 0: each message takes the next slot", unit="s",
        low=0.0, high=60.0,
    )  # fmt: skip
    one_fate: bool = parameter(
        True,
        "true: one channel for all topics, as of one radio; false: each has one, with random numbers of its own",
    )

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        super().__post_init__()
        if (self.schedule or self.reliable) and not self.period:
            what = "has a schedule" if self.schedule else "is reliable"
            raise ParameterError(
                f"a direction {what}, whose times say nothing where each message takes the next slot: set its period, "
                "the length of a slot"
            )
        for name in filter(None, self.topics):
            heard, arrow, called = name.partition(_ARROW)
            if not heard or (arrow and not called) or any(map(str.isspace, name)):
                raise ParameterError(f"topics holds {name!r}: write /scan, or /scan:=/edge/scan")

    def ways(self, direction: str, has_domains: bool) -> list[tuple[str, str]]:
        """What each topic is called before and behind the radio. Raises ParameterError if that is the same."""
        prefix = self.prefix or ("" if has_domains else PREFIXES[direction])
        found = []
        for name in filter(None, self.topics):
            heard, _, called = name.partition(_ARROW)
            called = called or (_prefixed(heard, prefix) if prefix else heard)
            if heard == called and not has_domains:
                raise ParameterError(
                    f"{direction}.topics: {heard} is called the same on both sides: write {heard}:=/another/name, set "
                    "a prefix, or give each side a domain (plant_domain_id, edge_domain_id)"
                )
            found.append((heard, called))
        return found


def _prefixed(name: str, prefix: str) -> str:
    """A topic's name with a prefix: /scan, edge -> /edge/scan; scan, edge -> edge/scan."""
    return f"/{prefix.strip('/')}{name}" if name.startswith("/") else f"{prefix.rstrip('/')}/{name}"


@dataclass(frozen=True)
class LinkEmulatorParameters(TwoDomains):
    """Parameters of the node `link_emulator`."""

    uplink: DirectionParameters = group(DirectionParameters)
    downlink: DirectionParameters = group(DirectionParameters)
    seed: int = parameter(1, "seed of all random outcomes of the channel", low=0, high=2**62)
    depth: int = parameter(
        1000, "messages of a topic that wait, at most, for the emulator and for those who listen to it", low=1,
        high=1_000_000,
    )  # fmt: skip
    pose_topic: str = parameter("", "topic of the AGV's pose, for the models that ask where it is; empty: nowhere")
    pose_type: str = parameter(
        "odometry", "its type; pose: geometry_msgs/PoseStamped, odometry: nav_msgs/Odometry", choices=POSE_TYPES
    )

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        ways = {name: direction.ways(name, self.has_domains) for name, direction in self.directions.items()}
        for heard, other in (("uplink", "downlink"), ("downlink", "uplink")):
            again = {before for before, _ in ways[heard]} & {behind for _, behind in ways[other]}
            if again:
                raise ParameterError(
                    f"{', '.join(sorted(again))} would cross the link forever: {heard}.topics hears what "
                    f"{other}.topics publishes; name another topic behind the radio"
                )
        for name, direction in self.directions.items():
            if direction.is_placed and not self.pose_topic:
                raise ParameterError(
                    f"{name}.model is {direction.model}, which asks where the AGV is, but pose_topic is empty: name it"
                )

    @property
    def directions(self) -> dict[str, DirectionParameters]:
        """By name."""
        return {"uplink": self.uplink, "downlink": self.downlink}

    @property
    def has_domains(self) -> bool:
        """Has each side a DDS domain of its own?"""
        return self.plant_domain_id != self.edge_domain_id
