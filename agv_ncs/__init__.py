"""An AGV's control loop over a lossy radio link, from Python: run it, read its recordings, learn whether it is stable.

    import agv_ncs

    scenario = agv_ncs.load_scenario("config/outages.yaml", ["controller.kx=50.0"])
    run = agv_ncs.simulate(scenario)
    print(agv_ncs.analyse(run).verdict.word, agv_ncs.margins(scenario).n_bursts)

Units are SI and radians; docs/python_api.md has the whole of it. A name is loaded when it is first asked for, so that
`import agv_ncs` takes no time, and so that packages of parts can import from here while their parts are being loaded.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agv_analysis.bags import Bag, read_bag
    from agv_analysis.corridor.corridor import Corridor, corridor
    from agv_analysis.report.page import write_report
    from agv_analysis.requirements.loop_requirements import LoopRequirements, require
    from agv_analysis.run import Run
    from agv_analysis.runtime.outcome import Outcome
    from agv_analysis.scenario import Scenario, load_scenario, parse_scenario
    from agv_analysis.simulation import simulate, simulate_batch
    from agv_analysis.stability.analysis import Analysis, Observations, analyse, observe
    from agv_analysis.stability.margins import Margins, margins
    from agv_ncs._parts import (
        channels,
        control_laws,
        register_channel,
        register_control_law,
        register_staleness_policy,
        register_vehicle,
        staleness_policies,
        vehicles,
    )
    from agv_ncs._recordings import read_recording, read_robot_recording
    from agv_ncs._run import run
    from agv_ncs._sweep import SweepResult, sweep
    from agv_ncs._version import __version__
    from agv_ros.errors import UserError
    from agv_ros.parts import Quantity

__all__ = [
    "Analysis",
    "Bag",
    "Corridor",
    "LoopRequirements",
    "Margins",
    "Observations",
    "Outcome",
    "Quantity",
    "Run",
    "Scenario",
    "SweepResult",
    "UserError",
    "__version__",
    "analyse",
    "channels",
    "control_laws",
    "corridor",
    "load_scenario",
    "margins",
    "observe",
    "parse_scenario",
    "read_bag",
    "read_recording",
    "read_robot_recording",
    "register_channel",
    "register_control_law",
    "register_staleness_policy",
    "register_vehicle",
    "require",
    "run",
    "simulate",
    "simulate_batch",
    "staleness_policies",
    "sweep",
    "vehicles",
    "write_report",
]

_MODULES = {
    "load_scenario": "agv_analysis.scenario",
    "parse_scenario": "agv_analysis.scenario",
    "Scenario": "agv_analysis.scenario",
    "simulate": "agv_analysis.simulation",
    "simulate_batch": "agv_analysis.simulation",
    "sweep": "agv_ncs._sweep",
    "SweepResult": "agv_ncs._sweep",
    "run": "agv_ncs._run",
    "Outcome": "agv_analysis.runtime.outcome",
    "read_bag": "agv_analysis.bags",
    "Bag": "agv_analysis.bags",
    "read_recording": "agv_ncs._recordings",
    "read_robot_recording": "agv_ncs._recordings",
    "Run": "agv_analysis.run",
    "analyse": "agv_analysis.stability.analysis",
    "Analysis": "agv_analysis.stability.analysis",
    "observe": "agv_analysis.stability.analysis",
    "Observations": "agv_analysis.stability.analysis",
    "margins": "agv_analysis.stability.margins",
    "Margins": "agv_analysis.stability.margins",
    "corridor": "agv_analysis.corridor.corridor",
    "Corridor": "agv_analysis.corridor.corridor",
    "require": "agv_analysis.requirements.loop_requirements",
    "LoopRequirements": "agv_analysis.requirements.loop_requirements",
    "write_report": "agv_analysis.report.page",
    "control_laws": "agv_ncs._parts",
    "vehicles": "agv_ncs._parts",
    "staleness_policies": "agv_ncs._parts",
    "channels": "agv_ncs._parts",
    "register_control_law": "agv_ncs._parts",
    "register_vehicle": "agv_ncs._parts",
    "register_staleness_policy": "agv_ncs._parts",
    "register_channel": "agv_ncs._parts",
    "Quantity": "agv_ros.parts",
    "UserError": "agv_ros.errors",
    "__version__": "agv_ncs._version",
}
"""Where each name comes from, in the order of docs/python_api.md."""


def __getattr__(name: str) -> Any:
    """Load a name when it is first asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
