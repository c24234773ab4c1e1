"""Running the loop on ROS 2; nothing else of the API needs it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from agv_analysis.runtime.outcome import Outcome
from agv_analysis.scenario import Scenario
from agv_ros.errors import UserError


def run(
    scenario: Scenario,
    bag: str | Path | None = None,
    processes: bool = False,
    progress: Callable[[int], None] = lambda steps: None,
) -> Outcome:
    """Run a scenario's nodes on ROS 2, in this process or in one process each; record to `bag`, a new directory.

    Returns how the run went; `read_recording(bag)` gives the run itself. `progress` receives the number of steps done.
    Raises UserError where ROS 2 is not installed, where a parameter or the bag's path cannot be used, and if the run
    ended early or its recording is not complete.
    """
    try:
        from agv_analysis.runtime.processes import run_in_processes
        from agv_analysis.runtime.runner import run_in_process
    except ImportError as error:
        raise UserError(
            f"agv_ncs.run needs ROS 2, which was not found ({error}): source your ROS 2 installation, or "
            "`pip install 'agv_ncs[ros]'`; agv_ncs.simulate runs the same loop without it"
        ) from None
    outcome = (run_in_processes if processes else run_in_process)(
        scenario, None if bag is None else Path(bag), progress
    )
    failures = [failure for failure in (outcome.failure, outcome.recording_failure) if failure]
    if failures:
        raise UserError("; ".join(failures))
    return outcome
