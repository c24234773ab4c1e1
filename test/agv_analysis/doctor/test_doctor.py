"""`agv-ncs doctor`: its facts against other sources of the same, with ROS and without."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

from agv_analysis.doctor import extras, machine, network
from agv_analysis.doctor.timed_loop import PERIOD, on_timer
from agv_ros.errors import UserError

WITHOUT_ROS = """
import sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("rclpy", "rpyutils"):
            raise ModuleNotFoundError(f"no ROS here: {name}", name=name)

sys.meta_path.insert(0, NoRos())
from agv_analysis.cli import main
main(sys.argv[1:])
"""


def test_as_json_it_says_where_it_ran(agv_ncs: Callable[..., tuple[int, str]]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    status, said = agv_ncs("doctor", "--json", "-", "--seconds", "0.5")
    assert status == 0, said
    found = json.loads(said)
    assert found["versions"]["agv_ncs"] == metadata.version("agv_ncs")
    assert found["versions"]["kernel"] == os.uname().release
    assert found["middleware"]["middleware"].startswith("rmw_")
    assert found["network"]["domain"] == int(os.environ["ROS_DOMAIN_ID"])
    assert found["network"]["range"] == "LOCALHOST"
    assert found["removed"] == []
    loop = found["loop"]
    assert (loop["failure"], loop["steps"]) == ("", 100)
    assert 0.0 <= loop["jitter_p50"] <= loop["jitter_p99"] <= loop["jitter_max"]
    assert 0.0 < loop["round_trip"]["p50"] <= loop["round_trip"]["max"]


def test_without_ros_it_says_so_and_times_a_timer(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WITHOUT_ROS, "doctor", "--seconds", "0.1", "--json", str(tmp_path / "facts.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "note: no ROS 2 here (no ROS here: rclpy" in done.stdout
    found = json.loads((tmp_path / "facts.json").read_text())
    assert found["middleware"] is None
    assert (found["loop"]["what"], found["loop"]["steps"]) == ("a timer, without ROS", 20)
    assert found["loop"]["round_trip"] is None


def test_a_timer_takes_the_time_of_its_steps() -> None:
    begin = time.monotonic()
    found = on_timer(0.1)
    assert time.monotonic() - begin >= 0.1 - PERIOD
    assert found.steps == 20


def test_an_extra_is_there_if_each_of_its_packages_is_new_enough() -> None:
    from packaging.requirements import Requirement

    here = metadata.version("numpy")
    needed = (f"numpy>={here}", "no-such-package-of-ours>=1", "click>=999")
    found = extras.installed([*map(Requirement, needed)])
    assert found["versions"]["numpy"] == here
    assert found["missing"] == ["no-such-package-of-ours>=1", "click>=999"]
    assert {"numpy", "click"} <= {one.name for one in extras.requirements()[""]}


def test_cores_and_their_governors_are_those_of_the_kernel(tmp_path: Path) -> None:
    for core in os.sched_getaffinity(0):
        folder = tmp_path / f"cpu{core}/cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text("powersave\n")
    found = machine.cores(tmp_path)
    assert found["usable"] == len(os.sched_getaffinity(0))
    assert found["governors"] == {"powersave": found["usable"]}


def test_the_clocks_are_those_of_this_machine() -> None:
    found = machine.clocks()
    assert found["steady_resolution"] == time.clock_getres(time.CLOCK_MONOTONIC)
    assert (found["offset"] is None) == (found["synchronised"] is not True)


# Fast DDS documents 7400, 7401 and 7410, 7411 for the first participant of domain 0; each domain is 250 on.
@pytest.mark.parametrize(
    ("domain", "participants", "multicast", "unicast"),
    [
        (0, 1, [7400, 7401], [7410, 7411]),
        (1, 2, [7650, 7651], [7660, 7661, 7662, 7663]),
        (42, 1, [17900, 17901], [17910, 17911]),
    ],
)
def test_the_ports_of_a_domain(domain: int, participants: int, multicast: list[int], unicast: list[int]) -> None:
    assert network.ports(domain, participants) == {"multicast": multicast, "unicast": unicast}


@pytest.mark.parametrize("domain", [-1, 233])
def test_a_domain_that_has_no_ports_is_refused(domain: int) -> None:
    with pytest.raises(UserError, match=r"0 \.\. 232"):
        network.ports(domain, 1)


@pytest.mark.parametrize(("said", "domain"), [("", 0), ("42", 42), ("lab", None), ("-3", None)])
def test_the_domain_is_that_of_the_environment(said: str, domain: int | None) -> None:
    found = network.discovery({"ROS_DOMAIN_ID": said})
    assert found["domain"] == domain
    assert (found["udp_ports"] is None) == (domain is None)
