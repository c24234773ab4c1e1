"""What the nodes said of their parameters in a recording, and the scenario that follows from it.

A recorder of this package asks each node and keeps the answers in a record of the bag; a node of this package says in
its diagnostics what was changed after which step; any node says on /parameter_events what it declares and what changes.
What a node said counts more than a params file, which may be another run's.
"""

from __future__ import annotations

import ast
import contextlib
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag
from agv_analysis.bags.writer import METADATA_NAME, NODES_NAME, REPLAY_OF, RESTART
from agv_analysis.recordings.messages_on_steps import stamps_of
from agv_analysis.run import ParameterChange
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_ros.messages import CHANGED
from agv_ros.parameters import SHARED, ParameterError, as_dict, parameters_of
from agv_ros.params_file import parse_sections

EVENTS = "/parameter_events"

_OF_THE_START = ("wait_for_subscribers", "stop_timeout", "stamp_window")
"""Parameters that say how nodes come up and end; a runner sets them."""

_OF_A_REPLAY = ("plan_steps", "trigger", "command_type")
"""What a replay sets for the nodes that it plays to."""

_CHANGE = re.compile(r"(.*) -> (.*) after step (-?\d+)", re.DOTALL)
"""What diagnostics say of a change."""

_OURS = "kx"
"""A parameter that the controller of this package has in every version."""

_VALUES = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value", 8: "double_array_value"}
"""Field of rcl_interfaces/ParameterValue by its type."""

Values = dict[str, dict[str, Any]]
"""By node, as in Scenario, and name."""


class Said(NamedTuple):
    """A scenario as its nodes said that they ran it."""

    scenario: Scenario
    """With the values that the recording begins with."""
    changes: tuple[ParameterChange, ...]
    """Changes after its first step, by step."""
    notes: tuple[str, ...]
    """A sentence for each parameter that was another than expected, and for each change."""
    foreign_controller: str = ""
    """Name of the node that gave the commands if it is none of this package; its law is not known."""


def said_by_nodes(bag: Bag, names: Mapping[str, str], diagnostics: str, scenario: Scenario, source: str) -> Said:
    """The scenario of a recording: `scenario`, which comes from `source`, with what the nodes said in its place.

    `names` are the bag's of the loop's topics, `diagnostics` that of its diagnostics. Raises ParameterError if nodes
    contradict each other, or run with parts that are not installed here.
    """
    record = bag.metadata.get(NODES_NAME, {})
    namespace = names["agv/pose"].removesuffix("agv/pose")
    nodes = {record.get(node, f"{namespace}{node}"): node for node in SCHEMAS}
    said = _asked(bag, record, list(_declared(bag, nodes)))
    begun = scenario.with_values(_for_all(said), f"{bag.path}: what its nodes said")
    changes = sorted(_changes(bag, names, diagnostics, nodes, begun), key=lambda change: change.k)
    changes += _of_restarts(bag, record, begun, changes)
    changes.sort(key=lambda change: change.k)
    first = int(stamps_of(bag[names["agv/pose"]]).min(initial=begun.grid.start_ns) - begun.grid.start_ns)
    first_k = max(0, first // begun.grid.ts_ns)
    at_start: Values = {node: {} for node in SCHEMAS}
    for change in reversed(changes):  # the value before the first change, or after the last one before the recording
        at_start[change.node][change.name] = change.old
    for change in changes:
        if change.k <= first_k:
            at_start[change.node][change.name] = change.new
    driven = begun.with_values(at_start, f"{bag.path}: what its nodes said")
    later = tuple(change for change in changes if change.k > first_k)
    foreign = _foreign_controller(bag, record)
    return Said(driven, later, (*_other_values(scenario, driven, source), *map(_of_change, later)), foreign)


def _foreign_controller(bag: Bag, record: Mapping[str, str]) -> str:
    """The node that publishes edge/cmd_vel, if it has been asked and has not the parameters of this package's."""
    if "controller" not in record:
        return ""
    sections = parse_sections(record["params"], f"{bag.path}: what its nodes said")
    return "" if _OURS in sections.get("controller", {}) else record["controller"]


def _asked(bag: Bag, record: Mapping[str, str], declared: list[tuple[str, str, Any]]) -> Values:
    """Values that nodes gave when they were asked, or else declared while the recorder listened."""
    found: Values = {node: {} for node in SCHEMAS}
    for node, name, value in declared:
        found[node].update(_known(node, {name: value}))
    if "params" in record:
        for node, section in parse_sections(record["params"], f"{bag.path}: what its nodes said").items():
            found.get(node, {}).update(_known(node, section))
    unused = {*_OF_THE_START, *(_OF_A_REPLAY if REPLAY_OF in bag.metadata.get(METADATA_NAME, {}) else ())}
    return {node: {name: v for name, v in values.items() if name not in unused} for node, values in found.items()}


def _of_restarts(
    bag: Bag, record: Mapping[str, str], begun: Scenario, changes: Sequence[ParameterChange]
) -> list[ParameterChange]:
    """What is another value in the process of a node that was started again, from the step on that it began with."""
    found: list[ParameterChange] = []
    for i in itertools.count(1):
        if f"{RESTART}{i}_from" not in record:
            return found
        k = max(0, -((begun.grid.start_ns - int(record[f"{RESTART}{i}_from"])) // begun.grid.ts_ns))
        sections = parse_sections(record[f"{RESTART}{i}_params"], f"{bag.path}: what its nodes said")
        for node, section in sections.items():
            now = as_dict(getattr(begun, node))
            now |= {change.name: change.new for change in (*changes, *found) if change.node == node and change.k <= k}
            for name, value in _known(node, section).items():
                if name not in _OF_THE_START and value != now[name]:
                    found.append(ParameterChange(k, node, name, now[name], value))
    return found


def _known(node: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Those values that the schema of a node of this package has a parameter for, and allows."""
    found, known = {}, parameters_of(SCHEMAS[node])
    for name, value in values.items():
        if name in known:
            with contextlib.suppress(ParameterError):  # another package's node may use the name for something else
                found[name] = known[name].check(node, value)
    return found


def _for_all(said: Values) -> Values:
    """The same, with what all nodes of a loop must agree on for those nodes that said nothing."""
    shared = {name: value for values in said.values() for name, value in values.items() if name in SHARED}
    return {node: shared | values for node, values in said.items()}


def _other_values(expected: Scenario, driven: Scenario, source: str) -> Iterator[str]:
    told: set[str] = set()
    for node in SCHEMAS:
        before, after = as_dict(getattr(expected, node)), as_dict(getattr(driven, node))
        for name, value in after.items():
            if value != before.get(name) and not (name in SHARED and name in told):
                told.add(name)
                yield (
                    f"{node}.{name} is {_text(before.get(name))} in {source}, but the node said {_text(value)}, which "
                    "counts"
                )


def _of_change(change: ParameterChange) -> str:
    return (
        f"{change.node}.{change.name} was changed while the loop ran: {_text(change.old)} before step {change.k}, "
        f"{_text(change.new)} from there on"
    )


def _text(value: Any) -> str:
    return "not there" if value is None else str(list(value) if isinstance(value, tuple) else value)


# -- changes -----------------------------------------------------------------------------------------------------------


def _changes(
    bag: Bag, names: Mapping[str, str], diagnostics: str, nodes: Mapping[str, str], begun: Scenario
) -> list[ParameterChange]:
    """Changes that nodes told, each once: by their diagnostics, and by events those of nodes that say nothing there."""
    exact = list(dict.fromkeys(_of_diagnostics(bag[diagnostics], nodes))) if diagnostics in bag else []
    told = {change.node for change in exact}
    return exact + [change for change in _of_events(bag, names, nodes, begun) if change.node not in told]


def _of_diagnostics(messages: NDArray[np.void], nodes: Mapping[str, str]) -> Iterator[ParameterChange]:
    """Changes in the diagnostics of this package's nodes, which repeat the last one of each parameter."""
    for message in messages:
        for i in range(int(message["len(status)"])):
            node = nodes.get("/" + message["status.name"][i].decode("utf-8", "replace"))
            pairs = zip(message["status.values.key"][i], message["status.values.value"][i], strict=True)
            for key, value in pairs if node else ():
                if key.startswith(CHANGED.encode()):
                    yield from _change(str(node), key.decode()[len(CHANGED) :], value.decode("utf-8", "replace"))


def _change(node: str, name: str, text: str) -> Iterator[ParameterChange]:
    found, known = _CHANGE.fullmatch(text), parameters_of(SCHEMAS[node])
    if found and name in known:
        with contextlib.suppress(ValueError, SyntaxError):  # UserError is one
            old, new = (known[name].check(node, _value(known[name].kind, word)) for word in found.groups()[:2])
            after = int(found[3])
            # A node that has answered nothing yet says "after step 0" as well: then step 0 has the new value already.
            yield ParameterChange(after + 1 if after > 0 else 0, node, name, old, new)


def _value(kind: str, text: str) -> Any:
    """A value as Python writes it."""
    if kind == "double":
        return float(text)  # which knows inf
    return text if kind == "string" else ast.literal_eval(text)


def _of_events(
    bag: Bag, names: Mapping[str, str], nodes: Mapping[str, str], begun: Scenario
) -> Iterator[ParameterChange]:
    """Changes on /parameter_events, at the first command that was logged after them."""
    commands, grid = bag[names["edge/cmd_vel"]], begun.grid
    logged, steps = commands["log_time_ns"], (stamps_of(commands) - grid.start_ns) // grid.ts_ns
    now = {node: as_dict(getattr(begun, node)) for node in SCHEMAS}
    for log_time_ns, node, name, value in _parameters_in(bag, "changed_parameters", nodes):
        for known in _known(node, {name: value}).values():
            later = np.flatnonzero(logged > log_time_ns)
            k = int(steps[later].min()) if len(later) else int(steps.max(initial=0)) + 1
            if now[node][name] != known:
                yield ParameterChange(k, node, name, now[node][name], known)
            now[node][name] = known


def _declared(bag: Bag, nodes: Mapping[str, str]) -> Iterator[tuple[str, str, Any]]:
    """Node, name and value of each parameter that was declared while the recorder listened."""
    for _, node, name, value in _parameters_in(bag, "new_parameters", nodes):
        yield node, name, value


def _parameters_in(bag: Bag, field: str, nodes: Mapping[str, str]) -> Iterator[tuple[int, str, str, Any]]:
    """Log time [ns], node, name and value of the parameters in a field of the events of a loop's nodes."""
    for message in bag.arrays.get(EVENTS, ()):
        node = nodes.get(message["node"].decode("utf-8", "replace"))
        for i in range(int(message[f"len({field})"]) if node else 0):
            kind = _VALUES.get(int(message[f"{field}.value.type"][i]))
            if kind:
                value = message[f"{field}.value.{kind}"][i]
                if kind.endswith("array_value"):
                    value = value[: int(message[f"len({field}.value.{kind})"][i])]
                yield int(message["log_time_ns"]), str(node), message[f"{field}.name"][i].decode(), _python(value)


def _python(value: Any) -> Any:
    """A value out of a structured array."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.tolist() if hasattr(value, "tolist") else value
