"""`agv-ncs doctor`: what of this machine matters to the loop, to paste into a report."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import OutputFile, with_force, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from agv_analysis.doctor.examination import Examination
    from agv_analysis.doctor.timed_loop import TimedLoop


@click.command("doctor", short_help="Check this machine: versions, network, clocks, jitter.")
@click.option(
    "--json", "json_file", type=OutputFile(allow_dash=True),
    help="Write the facts to this file, too; - prints them as JSON instead.",
)  # fmt: skip
@click.option("--fix", is_flag=True, help="Remove shared memory that dead processes of this user left behind.")
@click.option(
    "--seconds", type=click.FloatRange(0.0, 3600.0), default=3.0, show_default=True,
    help="For how long the loop is driven to see its jitter; 0: not at all.",
)  # fmt: skip
@with_force
def command(json_file: Path | None, fix: bool, seconds: float) -> None:
    """Say what of this machine matters to the loop: versions, middleware, network, clocks, cores, leftovers, jitter.

    The loop is driven on this host only, in a namespace of its own. Nothing is changed without --fix.

    \b
    Examples:
      agv-ncs doctor
      agv-ncs doctor --json - --seconds 0
      agv-ncs doctor --fix
    """
    from agv_analysis.doctor.examination import examine
    from agv_analysis.runtime.shared_memory import remove

    found = examine(seconds)
    if fix:
        found = replace(found, removed=remove(found.leftovers))
    if json_file == Path("-"):
        click.echo(json.dumps(found.to_json(), indent=2, allow_nan=False))
        return
    _print(found)
    if json_file is not None:
        write_json(json_file, found.to_json())
        click.echo(f"json: {json_file}")


def _print(found: Examination) -> None:
    """Plain lines, so that they can be pasted anywhere."""
    for name, value in _rows(found):
        click.echo(f"{name:<14} {value}")
    for one in found.removed:
        click.echo(f"removed: {one.path}")
    for note in found.notes():
        click.echo(f"note: {note}")


def _rows(found: Examination) -> Iterator[tuple[str, str]]:
    yield from found.versions.items()
    ros = found.middleware
    yield "ROS 2", "none" if ros is None else f"{ros['distribution']}, rclpy {ros['rclpy']} in {ros['path']}"
    yield "middleware", "none" if ros is None else ros["middleware"]
    yield from _network(found.network)
    yield from _machine(found.clocks, found.cores)
    for extra, packages in found.extras.items():
        versions = [f"{name} {version}" for name, version in packages["versions"].items() if version]
        absent = f"; missing: {', '.join(packages['missing'])}" if packages["missing"] else ""
        yield f"[{extra}]" if extra else "packages", (", ".join(versions) or "none") + absent
    size = sum(one.size for one in found.leftovers)
    yield "leftovers", f"{counted(len(found.leftovers), 'file')}, {size / 1e6:.1f} MB" if found.leftovers else "none"
    if found.loop is not None:
        yield from _loop(found.loop)


def _network(known: dict[str, Any]) -> Iterator[tuple[str, str]]:
    named = {"peers": "static_peers", "discovery server": "discovery_server", "profiles": "profiles"}
    also = "".join(f", {name} {known[key]}" for name, key in named.items() if known[key])
    yield "domain", f"{known['domain_said'] or '0, by default'}, range {known['range']}{also}"
    if ports := known["udp_ports"]:
        yield "UDP ports", ", ".join(f"{among[0]}-{among[-1]}" for among in ports.values())
    yield "SROS 2", "on" if known["security"] else "off"


def _machine(clocks: dict[str, Any], cores: dict[str, Any]) -> Iterator[tuple[str, str]]:
    states = {True: "synchronised", False: "not synchronised", None: "synchronisation not known"}
    offset = "" if clocks["offset"] is None else (
        f", {1e3 * clocks['offset']:.3f} ms to correct, {1e3 * clocks['offset_bound']:.0f} ms off at most"
    )  # fmt: skip
    resolution = f"resolution {1e9 * clocks['resolution']:.0f} ns, steady {1e9 * clocks['steady_resolution']:.0f} ns"
    yield "clock", f"{states[clocks['synchronised']]}{offset}, {resolution}"
    governors = ", ".join(f"{name} on {count}" for name, count in cores["governors"].items()) or "not known"
    load = " ".join(f"{value:.2f}" for value in cores["load"])
    yield "cores", f"{cores['usable']} of {cores['present']}, load {load}, governor {governors}"


def _loop(loop: TimedLoop) -> Iterator[tuple[str, str]]:
    if loop.failure:
        yield "loop", f"{loop.what}: failed"
        return
    yield "loop", f"{loop.what}: {counted(loop.steps, 'step')}, {loop.jitter['missed deadlines']:.0f} deadlines missed"
    yield "jitter", _quantiles({name.removeprefix("jitter "): value for name, value in loop.jitter.items()})
    if loop.round_trip:
        yield "round trip", _quantiles(loop.round_trip)


def _quantiles(of: dict[str, float]) -> str:
    return ", ".join(f"{name} {1e3 * of[name]:.3f} ms" for name in ("p50", "p99", "max"))
