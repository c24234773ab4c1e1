"""The watcher of a run, as a process beside it: the loop's process has nothing to do with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from agv_analysis.scenario import Scenario
from agv_ros.errors import UserError
from agv_ros.stopping import ENDS_WITH_STDIN

SERVED, STOP = "watch: ", "stop"
"""What the watcher prints: before the page's address, and when its button stop is pressed."""

OF_RUN = "AGV_NCS_WATCHES_ITS_RUN"
"""Environment variable of a watcher whose run listens to what it prints."""

_NICE = 5
"""The page yields to the loop."""

_PATIENCE = 10.0
"""How long [s] the watcher may take to end."""


@contextmanager
def watcher_beside(
    scenario: Scenario, params: Path, host: str, port: int, ready: Callable[[str], None]
) -> Iterator[None]:
    """A watcher of the loop of a scenario, whose params file is `params`; `ready` is told the page's address.

    The page's button stop sends this process SIGINT. Raises UserError if the watcher cannot start.
    """
    relay = scenario.relay
    sides = (("--plant-domain", relay.plant_domain_id), ("--edge-domain", relay.edge_domain_id))
    domains = [word for option, domain in sides if domain >= 0 for word in (option, str(domain))]
    command = [
        sys.executable, "-m", "agv_analysis.cli", "watch", "--config", str(params), "--host", host, "--port",
        str(port), "--no-browser", *domains,
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True, env={**os.environ, "PYTHONUNBUFFERED": "1", ENDS_WITH_STDIN: "1", OF_RUN: "1"},
    )  # fmt: skip
    assert process.stdout is not None
    try:
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
        said = ""
        for line in process.stdout:
            said = line.strip()
            if said.startswith(SERVED):
                break
        else:
            raise UserError(f"the page of the run cannot be served: {said.removeprefix('Error: ')}")
        ready(said.removeprefix(SERVED))
        reader = threading.Thread(target=_obey, args=(process,), daemon=True)
        reader.start()
        yield
    finally:
        _end(process)


def _obey(process: subprocess.Popen[str]) -> None:
    """Body of a thread: end this process's run when the page says so."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == STOP:
            os.kill(os.getpid(), signal.SIGINT)


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdin.close()
