"""The functions of the loop that a scenario's parts replace, and loops that are run with them."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from agv_analysis.compiled.functions import HAS_NUMBA, compiled
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.link_loop import recall_memory, store_memory
from agv_cloud.control.command import control_law
from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_cloud.staleness.estimate import staleness_policy
from agv_cloud.staleness.registry import COMPILED, STALENESS_POLICIES
from agv_plant.vehicle.motion import vehicle_step
from agv_plant.vehicle.registry import UNICYCLE, VEHICLES
from agv_ros.parts import PartError, complaint, culprit
from agv_ros.substitution import Function, Replacements, replaced


def replacements_of(scenario: Scenario) -> Replacements:
    """The scenario's control law, staleness policy and vehicle, by the placeholders that the loop calls.

    Those that the placeholders are themselves are left out, so that loops of the same parts are compiled once.
    """
    law, policy, vehicle = scenario.controller.law, scenario.error_detector.policy, scenario.plant.vehicle
    found: dict[Function, Function] = {}
    if law != KANAYAMA:
        chosen = CONTROL_LAWS.find(law)
        found[control_law] = chosen.adapter
        if chosen.memory:
            found[recall_memory], found[store_memory] = memory_functions(len(chosen.memory))
    if policy not in COMPILED:
        found[staleness_policy] = STALENESS_POLICIES.find(policy).adapter
    if vehicle != UNICYCLE:
        found[vehicle_step] = VEHICLES.find(vehicle).adapter
    return found


@functools.cache
def memory_functions(size: int) -> tuple[Function, Function]:
    """`recall_memory` and `store_memory` for a memory of `size` numbers.

    Written out number by number, for a compiler must know the length of a tuple.
    """
    recalled = "".join(f"row[{i}], " for i in range(size))
    stored = "".join(f"    row[{i}] = memory[{i}]\n" for i in range(size))
    text = f"def recall(row):\n    return ({recalled})\n\n\ndef store(row, memory):\n{stored}"
    known: dict[str, Any] = {}
    exec(compile(text, f"<memory of {size} numbers>", "exec"), known)
    recall, store = known["recall"], known["store"]
    recall.__doc__ = store.__doc__ = text
    return recall, store


_NOT_COMPILED: set[tuple[Function, tuple[tuple[Function, Function], ...]]] = set()
"""Loops, with their parts, that numba has refused: it would take seconds to refuse them again."""


def run_parts(loop: Function, parts: Replacements, *arguments: Any) -> Any:
    """A loop with its parts, compiled; as plain Python where a part is more than numba compiles. The numbers are equal.

    Raises PartError if a part raises or returns NaN.
    """
    if not parts:
        return compiled(loop)(*arguments)
    key = loop, tuple(parts.items())
    if HAS_NUMBA and key not in _NOT_COMPILED:
        try:
            return compiled(loop, parts)(*arguments)
        except Exception:  # from numba or from a part in it; plain Python tells which
            found = _run_plain(loop, parts, arguments)
            _NOT_COMPILED.add(key)
            return found
    return _run_plain(loop, parts, arguments)


def _run_plain(loop: Function, parts: Replacements, arguments: tuple[Any, ...]) -> Any:
    try:
        # What comes out of arrays shall do what floats do: diverge quietly, but not divide by zero.
        with np.errstate(divide="raise", over="ignore", invalid="ignore"):
            return replaced(loop, parts)(*arguments)
    except Exception as error:
        where = culprit(error)
        if not where:
            raise
        raise PartError(f"{where} {complaint(error)}") from error
