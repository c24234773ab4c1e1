"""The paper's test: is every eigenvalue of A(k) inside the unit circle, at every step?"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.stability import paper
from agv_analysis.stability.criteria.criterion import (
    Border,
    Criterion,
    Judgement,
    Margin,
    Row,
    RunFacts,
    ScenarioFacts,
)
from agv_analysis.stability.derived_loop import is_kanayamas_law
from agv_plant.vehicle.registry import UNICYCLE

_OTHER_LOOP = "no answer: eq. 21 is of Kanayama's law on a unicycle"


@dataclass(frozen=True)
class PaperTest:
    """The paper's test along a run: is the spectral radius of A(k) below 1 at every step?"""

    radius: float
    """The largest spectral radius."""
    k: int
    """The step that has it."""

    @property
    def stable(self) -> bool:
        """The paper's answer."""
        return self.radius < 1.0


def applies_to(scenario: Scenario) -> bool:
    """Is it the law and the vehicle that eq. 21 was written for?"""
    return scenario.plant.vehicle == UNICYCLE and is_kanayamas_law(scenario)


def paper_test(run: Run) -> PaperTest:
    """The paper's test (eq. 21, 24) with the headings, speeds and outages of a run."""
    radii = paper.spectral_radii(*paper_inputs(run), run.scenario.controller, run.ts)
    worst = int(np.argmax(radii))
    return PaperTest(float(radii[worst]), int(run.k[worst]))


def paper_inputs(run: Run) -> tuple[Floats, Floats, Floats]:
    """What A(k) of eq. 21 depends on at each step: theta_c(k), theta_c(k-n) [rad], v_r(k-n) [m/s], each of shape (N,).

    Where the pose that the edge held is missing from the recording the oldest one before it stands for it.
    """
    held = np.clip(np.searchsorted(run.k, run.k - run.n_ul), 0, len(run) - 1)
    theta = run.pose[:, 2]
    return theta, theta[held], run.reference[held, 3]


def _judge(facts: RunFacts) -> Judgement | None:
    if not applies_to(facts.run.scenario):
        return None
    found = paper_test(facts.run)
    return Judgement(
        "Paper's test", found.stable, f"|lambda| at most {found.radius:.6g}, at step {found.k}",
        {"paper_stable": found.stable, "paper_radius": finite(found.radius)}, found,
    )  # fmt: skip


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    name, label = "n_max.paper", "Paper's test, constant n_ul"
    if not applies_to(facts.scenario):
        yield Margin(name, label, None, reason=_OTHER_LOOP)
        return
    n = paper.largest_n(facts.lap[:, 2], facts.lap[:, 3], facts.scenario.controller, facts.scenario.plant.ts)
    if n is None:
        reason = "no bound: the test holds for every n, since it sees an outdated pose only by how far it has turned"
        yield Margin(name, label, None, reason=reason)
    else:
        yield Margin(name, label, n, _tolerates(n))


def _at_once(facts: RunFacts) -> Iterable[Row]:
    """The largest n for which the paper's test holds on the track as far as it was driven."""
    run = facts.run
    if not applies_to(run.scenario):
        yield "Paper's test", _OTHER_LOOP
        return
    n = paper.largest_n(run.reference[:, 2], run.reference[:, 3], run.scenario.controller, run.ts)
    if n is None:
        yield "Paper's test", "tolerates any number of consecutive outages"
    else:
        yield "Paper's test", _tolerates(n)


def _tolerates(n: int) -> str:
    """What the test says of a constant age of up to `n` slots."""
    return "fails even without outages" if n < 0 else f"tolerates up to {n} consecutive outages"


def _border(scenario: Scenario) -> float:
    """Spectral radius of A(k) along a straight track at 1 m/s, less 1, whatever the losses; NaN for another loop."""
    if not applies_to(scenario):
        return math.nan
    straight = np.zeros(1)
    return float(paper.spectral_radii(straight, straight, np.ones(1), scenario.controller, scenario.plant.ts)[0]) - 1.0


CRITERION = Criterion(
    key="paper",
    order=10,
    title="The paper's test",
    asks="Are all eigenvalues of A(k) (eq. 21) inside the unit circle at every step?",
    assumes="That the outdated pose is the current one; so on a straight track it cannot see outages at all.",
    judge=_judge,
    margins=_margins,
    margin_names=(("n_max.paper", "Paper's test, constant n_ul"),),
    at_once=_at_once,
    border=Border("paper's test", _border),
)
