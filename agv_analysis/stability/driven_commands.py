"""Were the recorded commands those of the scenario's control law? If not: of which gains, and from which step on?

A command is a function of the tracking error, the reference's speeds, the law's gains and its limit, and of nothing
else. All of these are recorded or named by the parameters, so that each command can be held against them, and each
error against the pose that the edge held. Where commands disagree, the rest of the recording is cut into pieces of
constant gains, and `gain_fit` looks for these.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.edge_answers import (
    answers_to_errors,
    differs,
    errors_apart,
    errors_of_poses,
    held_poses,
    sizes_of,
    speeds_with_errors,
)
from agv_analysis.simulation.single import settings_of
from agv_analysis.stability.gain_fit import Driven, Samples, agreement, explain
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.parameters import PATH
from agv_cloud.staleness.estimate import is_stepwise
from agv_cloud.staleness.registry import number_of
from agv_ros.counted import counted
from agv_ros.parts import PartError

_MOST_PIECES = 4
"""More pieces of constant gains are not looked for: any commands are explained if each has gains of its own."""

_SHORTEST_PIECE = 16
"""Steps that a piece has at least, unless the recording ends with it."""

_AROUND_CHANGE = 20
"""Steps beside a recorded change of a parameter that may follow either value: foreign nodes stamp it by their clock."""

_FEW = 0.1
"""Share of commands that differ, below which another publisher is likelier than another law."""

_SAME_GAIN = 1e-6
"""Largest difference of two gains that is none, relative to them."""

_OWN = "these parameters"
"""Words of a piece under the scenario's own."""

_SAME_ERROR = 1e-6
"""Largest difference [m, rad] between a recorded error and the one that follows from track and pose, at the origin."""


class Piece(NamedTuple):
    """Steps under constant gains, from step `k` on."""

    k: int
    driven: dict[str, float]
    """Parameters of the controller that were others than the scenario's, by name; empty: the scenario's own."""
    words: str
    """As a person reads it: `K_x = 50.0, not 25.0`."""


@dataclass(frozen=True)
class DrivenCommands:
    """How far the recorded commands are from the law with the run's parameters; sizes in m/s and rad/s."""

    compared: int
    """Steps with both an error and a command."""
    first: int | None
    """First step k whose command differs; None: none does."""
    first_size: float
    """Difference at that step, the larger of v and w; inf: the law has no answer there."""
    largest: float
    share: float
    """Share of the compared steps that differ."""
    pieces: tuple[Piece, ...]
    """What was driven from `first` on; empty where no gains explain it."""
    sentence: str
    """For a person; empty if nothing differs."""
    cannot_say: str = ""
    """Why the commands, or some of them, could not be compared; empty if they could."""

    @property
    def differs(self) -> bool:
        """Was something else driven than the run's parameters say?"""
        return self.first is not None

    def to_json(self) -> dict[str, Any]:
        """Plain values; an infinite size is null."""
        plain = asdict(self) | {"differs": self.differs}
        plain["pieces"] = [piece._asdict() | {"driven": _without_inf(piece.driven)} for piece in self.pieces]
        return _without_inf(plain)


def _without_inf(values: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value == np.inf else value for name, value in values.items()}


def driven_commands(run: Run) -> DrivenCommands:
    """Hold the commands of a run against the control law of its scenario, under the changes that the run knows of."""
    usable = np.asarray(np.isfinite(run.error).all(axis=1) & np.isfinite(run.command).all(axis=1))
    cannot_say = _why_not(run, usable)
    usable[_known_until(run, usable) :] = False
    if not usable.any():
        return DrivenCommands(0, None, 0.0, 0.0, 0.0, (), "", cannot_say)
    speeds = speeds_with_errors(run)
    sizes = sizes_of(_computed(run, speeds)[usable] - run.command[usable])
    k, wrong = run.k[usable], differs(sizes, run.command[usable])
    if not wrong.any():
        return DrivenCommands(len(k), None, 0.0, float(sizes.max()), 0.0, (), "", cannot_say)
    first = int(np.argmax(wrong))
    rest = usable & (run.k >= k[first])
    samples = Samples(run.error[rest], speeds[rest], run.command[rest])
    pieces = _pieces(run, run.k[rest], samples)
    return DrivenCommands(
        compared=len(k),
        first=int(k[first]),
        first_size=float(sizes[first]),
        largest=float(sizes.max()),
        share=float(wrong.mean()),
        pieces=pieces,
        sentence=_sentence(run, k, wrong, pieces),
        cannot_say=cannot_say,
    )


def wrong_errors(run: Run) -> tuple[int, int]:
    """How many recorded errors do not belong to track, policy and the pose that the edge held, and of how many.

    (0, 0) where the recording cannot say: which commands a policy knew in an edge that steps by its own clock, and what
    was ahead on a path that may have been replaced since.
    """
    edge = run.scenario.error_detector
    if (edge.trigger == "timer" and is_stepwise(number_of(edge.policy))) or (edge.track == PATH and edge.steps_ahead):
        return 0, 0
    held, there = held_poses(run)
    known = there & np.isfinite(run.error).all(axis=1)
    if not known.any():
        return 0, 0
    try:
        error = errors_of_poses(run, run.scenario)
    except PartError:
        return 0, 0
    apart = sizes_of(errors_apart(error, run.error))[known]
    scale = 1.0 + np.abs(run.sent_pose[held[known], :2]).max(axis=1)
    return int(np.count_nonzero(apart > _SAME_ERROR * scale)), int(np.count_nonzero(known))


def scenarios_of(run: Run) -> list[tuple[int, Scenario]]:
    """The scenario of each part of a run between changes of parameters, after the step that it begins with."""
    found = [(int(run.k[0]), run.scenario)]
    for change in sorted(run.parameter_changes, key=lambda change: change.k):
        changed = found[-1][1].with_values({change.node: {change.name: change.new}})
        if change.k <= found[-1][0]:
            found.pop()
        found.append((max(change.k, int(run.k[0])), changed))
    return found


# -- what can be compared ----------------------------------------------------------------------------------------------


def _known_until(run: Run, usable: NDArray[np.bool_]) -> int:
    """Rows before this one can be compared: of a law that remembers, only those before the first gap."""
    if not CONTROL_LAWS.find(run.scenario.controller.law).memory or not run.gains_known:
        return len(run) if run.gains_known else 0
    if run.k[0] > 0:
        return 0
    gap = np.append(np.diff(run.k) != 1, True)
    gap[:-1] |= usable[:-1] & ~usable[1:]
    return int(np.argmax(gap)) + 1


def _why_not(run: Run, usable: NDArray[np.bool_]) -> str:
    if not run.gains_known:
        return "the controller's gains are not known, so the commands cannot be held against them"
    if not usable.any():
        return "no step has both an error and a command, so the commands cannot be held against the control law"
    row, law = _known_until(run, usable), run.scenario.controller.law
    if row == 0:
        return f"{law} remembers, and the recording begins at step {run.k[0]}: its commands cannot be checked"
    if row < len(run):
        return f"{law} remembers, and steps are missing: its commands can only be checked before step {run.k[row]}"
    return ""


def _computed(run: Run, speeds: Floats) -> Floats:
    """The commands of the law under the parameters that the run knows of, shape (N, 2)."""
    parts = scenarios_of(run)
    rows = [*np.searchsorted(run.k, [k for k, _ in parts]).tolist(), len(run)]
    memory = CONTROL_LAWS.find(run.scenario.controller.law).memory
    pieces = []
    for (_, scenario), begin, end in zip(parts, rows[:-1], rows[1:], strict=True):
        found, memory = answers_to_errors(
            run.error[begin:end], speeds[begin:end], memory, settings_of(scenario), scenario
        )
        pieces.append(found)
    computed = np.concatenate(pieces)
    if not memory:
        for (_, before), (_, after), row in zip(parts[:-1], parts[1:], rows[1:-1], strict=True):
            near = slice(max(0, row - _AROUND_CHANGE), row + _AROUND_CHANGE)
            for scenario in (before, after):
                other, _ = answers_to_errors(run.error[near], speeds[near], (), settings_of(scenario), scenario)
                with np.errstate(invalid="ignore"):  # a command that is not finite is not compared
                    nearer = sizes_of(other - run.command[near]) < sizes_of(computed[near] - run.command[near])
                computed[near][nearer] = other[nearer]
    return computed


# -- what was driven instead -------------------------------------------------------------------------------------------


def _pieces(run: Run, k: NDArray[np.int64], samples: Samples) -> tuple[Piece, ...]:
    """Pieces of constant gains that together give all commands of the steps `k`; none if there are none such."""
    parts = scenarios_of(run)
    if CONTROL_LAWS.find(run.scenario.controller.law).memory:
        return ()
    found: list[Piece] = []
    rows = [*np.searchsorted(k, [first for first, _ in parts]).tolist(), len(k)]
    for (_, scenario), begin, end in zip(parts, rows[:-1], rows[1:], strict=True):
        while begin < end:
            driven, length = _longest(samples.rows(begin, end), scenario)
            if driven is None or len(found) == _MOST_PIECES:
                return ()
            found.append(_piece(int(k[begin]), driven, scenario))
            begin += length
    return tuple(found)


def _longest(samples: Samples, scenario: Scenario) -> tuple[Driven | None, int]:
    """Gains that give the first commands of `samples`, and how many of them, as many as there are."""
    total = width = len(samples.command)
    try:
        while width >= min(_SHORTEST_PIECE, total):
            driven = explain(samples.rows(0, width), scenario)
            if driven is not None:
                agrees = agreement(driven, samples, scenario)
                return driven, total if agrees.all() else int(np.argmin(agrees))
            width //= 2
    except PartError:
        pass
    return None, 0


def _piece(k: int, driven: Driven, scenario: Scenario) -> Piece:
    controller, law = scenario.controller, CONTROL_LAWS.find(scenario.controller.law)
    values, words, unknown = {}, [], []
    for i, (own, gain, parameter) in enumerate(zip(controller.gains, driven.gains, law.parameters, strict=True)):
        if abs(gain - own) <= _SAME_GAIN * max(1.0, abs(own)):
            continue
        if i in driven.untold:
            unknown.append(_symbol(parameter.name, parameter.description))
            continue
        values[parameter.name] = gain
        words.append(f"{_symbol(parameter.name, parameter.description)} = {_number(gain)}, not {_number(own)}")
    if driven.v_max != controller.v_max:
        values["v_max"] = driven.v_max
        words.append(_limit_words(driven.v_max, controller.v_max))
    for name, factor in zip("vw", driven.factors, strict=True):
        if factor == -1.0:
            words.append(f"the sign of {name} turned")
        elif factor != 1.0:
            words.append(f"{_number(factor)} times the law's {name}")
    if unknown:
        words.append(f"{' and '.join(unknown)} that these errors do not tell")
    return Piece(k, values, ", ".join(words) if words else _OWN)


def _limit_words(driven: float, own: float) -> str:
    if np.isinf(driven):
        return f"no v_max that shows, not {_number(own)} m/s"
    return f"v_max = {_number(driven)} m/s, not {'none' if np.isinf(own) else f'{_number(own)} m/s'}"


def _symbol(name: str, description: str) -> str:
    """A gain as its law's documentation writes it: K_x for kx."""
    symbols: Sequence[str] = re.findall(r"\b[A-Za-z]_[a-z]+\b", description)
    return next((symbol for symbol in symbols if symbol.replace("_", "").lower() == name.lower()), name)


def _number(value: float) -> str:
    return repr(float(f"{value:.7g}"))


def _sentence(run: Run, k: NDArray[np.int64], wrong: NDArray[np.bool_], pieces: Sequence[Piece]) -> str:
    def at(step: int) -> str:
        return f"step {step} ({step * run.ts:.6g} s)"

    first, law = int(k[np.argmax(wrong)]), run.scenario.controller.law
    if pieces and pieces[0].words == _OWN:  # the first command differs, so these were not driven there
        return (
            f"commands differ from the control law with these parameters from {at(first)} on, at errors so small that "
            "they do not tell which gains were driven"
        )
    if pieces:
        said = "; ".join(
            f"driven with {piece.words}" if i == 0 else f"from {at(piece.k)} on with {piece.words}"
            for i, piece in enumerate(pieces)
        )
        return f"commands differ from the control law with these parameters from {at(first)} on: {said}"
    count, total = int(np.count_nonzero(wrong)), len(wrong)
    if CONTROL_LAWS.find(law).memory:
        return (
            f"{count} of {counted(total, 'command is', 'commands are')} not those of {law} with these "
            f"parameters, the first at {at(first)}"
        )
    after = wrong[np.argmax(wrong) :]
    if after.mean() < _FEW:
        return (
            f"{count} of {counted(total, 'command is', 'commands are')} not those of the control law, the first "
            f"at {at(first)}: did anything "
            "else publish commands?"
        )
    return (
        f"commands differ from the control law with these parameters from {at(first)} on: no gains of {law} explain "
        "these commands"
    )
