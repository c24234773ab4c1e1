"""Leftovers of dead processes in shared memory: found, and nothing else is; removed, and nothing else is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from agv_analysis.runtime.processes import _clean_up, _Process
from agv_analysis.runtime.shared_memory import SHARED_MEMORY, Leftover, leftovers, remove

USER = """
import fcntl, mmap, sys
from pathlib import Path

folder = Path(sys.argv[1])
for name in ("fastrtps_mapped", "iox_mapped"):
    (folder / name).write_bytes(bytes(4096))
    with open(folder / name, "r+b") as file:
        globals()[name] = mmap.mmap(file.fileno(), 0)
for name in ("fastrtps_port7410", "sem.fastrtps_port7410_mutex", "fastrtps_port7410_el"):
    (folder / name).write_bytes(b"")
lock = open(folder / "fastrtps_port7410_el")
fcntl.flock(lock, fcntl.LOCK_EX)
print("ready", flush=True)
sys.stdin.read()
"""

NODE = """
import sys, rclpy
rclpy.init()
node = rclpy.create_node("killed", start_parameter_services=False)
print("ready", flush=True)
sys.stdin.read()
"""


def started(program: str, *arguments: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def killed(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def test_what_a_living_process_maps_or_locks_is_no_leftover_and_of_a_dead_one_it_is(tmp_path: Path) -> None:
    for name in ("fastrtps_data", "notes_of_a_person"):
        (tmp_path / name).write_bytes(bytes(8))
    (tmp_path / "fastrtps_link").symlink_to(tmp_path / "notes_of_a_person")
    process = started(USER, str(tmp_path))
    try:
        assert leftovers(tmp_path, 0.0) == [Leftover(tmp_path / "fastrtps_data", 8, True)]
        assert leftovers(tmp_path, 3600.0) == []  # too young to be sure
    finally:
        killed(process)
    found = leftovers(tmp_path, 0.0)
    assert {one.path.name for one in found} == {
        "fastrtps_data", "fastrtps_mapped", "iox_mapped", "fastrtps_port7410", "fastrtps_port7410_el",
        "sem.fastrtps_port7410_mutex",
    }  # fmt: skip
    assert remove(found, 0.0) == found
    assert {path.name for path in tmp_path.iterdir()} == {"notes_of_a_person", "fastrtps_link"}


def test_what_is_in_use_again_or_another_users_is_not_removed(tmp_path: Path) -> None:
    for name in ("fastrtps_port7410", "fastrtps_other"):
        (tmp_path / name).write_bytes(b"")
    port, other = (
        Leftover(tmp_path / name, 0, name != "fastrtps_other") for name in ("fastrtps_port7410", "fastrtps_other")
    )
    process = started(USER, str(tmp_path))
    try:
        assert remove([port, other], 0.0) == []
    finally:
        killed(process)
    assert port.path.exists()
    assert other.path.exists()


def test_a_killed_node_leaves_segments_behind_that_are_found() -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    process = started(NODE)
    maps = Path(f"/proc/{process.pid}/maps").read_text()
    segments = {SHARED_MEMORY / name for name in re.findall(r"/dev/shm/(fastrtps_[0-9a-f]{16})$", maps, re.MULTILINE)}
    try:
        assert segments
        assert not segments & {one.path for one in leftovers(settled=0.0)}
    finally:
        killed(process)
        ports = {SHARED_MEMORY / name for name in re.findall(r"/dev/shm/(\S*fastrtps_port\S+)$", maps, re.MULTILINE)}
        names = segments | {Path(f"{path}_el") for path in segments} | ports
        found = [one for one in leftovers(settled=0.0) if one.path in names]
        removed = remove(found, 0.0)
    assert segments <= {one.path for one in removed}
    assert not any(path.exists() for path in segments)


def test_a_port_that_was_made_a_moment_ago_goes_with_the_run_whose_node_was_killed() -> None:
    """Who still sent to that node made it anew."""
    node = _Process("node", [sys.executable, "-c", "import time; time.sleep(60)"])
    port = SHARED_MEMORY / f"fastrtps_port_of_test_{os.getpid()}"
    try:
        node.collect()
        port.write_bytes(b"ring")
        _clean_up([node])
        assert not port.exists()
    finally:
        port.unlink(missing_ok=True)
