"""All facts of a machine, and what of them a person should look at."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from agv_analysis.doctor import extras, machine, network
from agv_analysis.doctor.timed_loop import TimedLoop, on_dds, on_timer
from agv_analysis.runtime.shared_memory import Leftover, leftovers
from agv_analysis.version import version
from agv_ros.counted import counted


@dataclass(frozen=True)
class Examination:
    """What was found."""

    versions: dict[str, str]
    middleware: dict[str, str] | None
    """None without ROS; why not says `no_ros`."""
    no_ros: str
    network: dict[str, Any]
    clocks: dict[str, Any]
    cores: dict[str, Any]
    extras: dict[str, dict[str, Any]]
    """Of each extra its packages and what is missing; under "" what is always needed."""
    leftovers: list[Leftover]
    loop: TimedLoop | None
    removed: list[Leftover] = field(default_factory=list)

    def notes(self) -> list[str]:
        """What a person should look at, with what to do."""
        return list(_notes(self))

    def to_json(self) -> dict[str, Any]:
        """As the JSON file has it; seconds and bytes."""
        return {
            "versions": self.versions,
            "middleware": self.middleware,
            "no_ros": self.no_ros,
            "network": self.network,
            "clocks": self.clocks,
            "cores": self.cores,
            "extras": {extra or "always": found for extra, found in self.extras.items()},
            "leftovers": [one.to_json() for one in self.leftovers],
            "removed": [one.to_json() for one in self.removed],
            "loop": None if self.loop is None else self.loop.to_json(),
            "notes": self.notes(),
        }


def examine(seconds: float) -> Examination:
    """Gather all facts; the loop is driven for some seconds, not at all for 0."""
    found, no_ros = _ros()
    needed = extras.requirements()
    loop = None
    if seconds > 0.0:
        loop = on_timer(seconds) if found is None else on_dds(seconds)
    return Examination(
        versions={"agv_ncs": version(), "python": platform.python_version(), **machine.system()},
        middleware=found,
        no_ros=no_ros,
        network=network.discovery(),
        clocks=machine.clocks(),
        cores=machine.cores(),
        extras={extra: extras.installed(packages) for extra, packages in needed.items()},
        leftovers=leftovers(),
        loop=loop,
    )


def _ros() -> tuple[dict[str, str] | None, str]:
    try:
        from agv_analysis.runtime.middleware import middleware

        return middleware(), ""
    except ImportError as error:
        return None, str(error)


def _notes(found: Examination) -> Iterator[str]:
    if found.middleware is None:
        yield (
            f"no ROS 2 here ({found.no_ros}): simulation and analysis work; for the nodes source a ROS 2 installation, "
            "or pip install 'agv_ncs[ros]'"
        )
    if missing := found.extras.get("", {}).get("missing"):
        yield f"needed and not there, or too old: pip install {' '.join(map(repr, missing))}"
    domain = found.network["domain"]
    if found.network["udp_ports"] is None:
        yield f"ROS_DOMAIN_ID is {found.network['domain_said']!r}: must be an integer in 0 .. 232"
    elif domain > network.LARGEST_DOMAIN:
        yield f"ROS_DOMAIN_ID is {domain}: its ports may be taken by any program on Linux; take 0 .. 101"
    if found.clocks["synchronised"] is False:
        yield "the time of day is not synchronised: between two hosts a drift of the clocks counts as age of the poses"
    governors = [name for name in found.cores["governors"] if name not in ("performance", "schedutil")]
    if governors:
        yield f"the cores' frequency follows the governor {', '.join(governors)}: `performance` has the least jitter"
    if found.cores["load"][0] > found.cores["usable"]:
        yield f"{found.cores['load'][0]:.1f} processes wait for {found.cores['usable']} cores: jitter is not the loop's"
    left = [one for one in found.leftovers if one not in found.removed]
    if left:
        mine = sum(one.mine for one in left)
        yield (
            f"{counted(len(left), 'file')} of shared memory belong to no process that lives, {mine} of them yours: "
            "agv-ncs doctor --fix removes yours"
        )
    yield from _notes_on_loop(found.loop)


def _notes_on_loop(loop: TimedLoop | None) -> Iterator[str]:
    if loop is None:
        return
    if loop.failure:
        yield f"{loop.what} failed: {loop.failure}"
    elif missed := loop.jitter["missed deadlines"]:
        yield (
            f"{missed:.0f} of {counted(loop.steps, 'deadline was', 'deadlines were')} missed: in real time this "
            "machine decides what comes out"
        )
