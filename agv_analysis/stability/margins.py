"""How much a scenario can take: the largest outage, loss probability and burst by each criterion, and what binds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from agv_analysis.scenario import Scenario
from agv_analysis.stability.criteria import CRITERIA
from agv_analysis.stability.criteria.criterion import Criterion, Margin, ScenarioFacts
from agv_analysis.stability.empirical import Twins
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_plant.parameters import ChannelParameters, PlantParameters
from agv_ros.counted import counted
from agv_ros.parameters import as_dict

GROWTH = ".mean_square_growth"
"""End of the names of margins that are the growth of E[e^2] with the links as they are."""

_PLAIN = 10.0
"""How much E[e^2] must die out over a run (logarithm) for twins that do not contract to speak against it."""

_UNKNOWN_TO_CRITERIA = ("noise_xy", "noise_theta", "slip_noise")
"""Parameters of the plant that no criterion but the empirical one knows."""


@dataclass(frozen=True)
class Margins:
    """Margins of a loop on its track, by their place in JSON, as `n_max.lifted`.

    None: there is no bound, or the criterion is not met at all; its reason says which. A number of steps of -1: the
    loop does not contract even if every pose is fresh.
    """

    found: Mapping[str, Margin]
    infeasible: str = ""
    """Why the loop does not settle even without losses; empty if it does."""
    notes: tuple[str, ...] = ()
    """What must be known of the motion about which the loop was linearised: limits that are active on it."""
    left_out: tuple[str, ...] = ()
    """What the scenario has and these margins do not know."""
    twins: Twins | None = None
    """Simulated twins of the very scenario, where there are any."""

    def __getitem__(self, name: str) -> Any:
        """The value of a margin."""
        return self.found[name].value

    @property
    def reasons(self) -> dict[str, str]:
        """Why a margin is None, or what must be known of it, by its name."""
        return {name: margin.reason for name, margin in self.found.items() if margin.reason}

    @property
    def n_paper(self) -> int | None:
        """Largest constant n_ul for which the paper's test holds at every step of a lap."""
        found: int | None = self._value("n_max.paper")
        return found

    @property
    def n_lifted(self) -> int | None:
        """Largest constant n_ul under which a lap contracts every small error."""
        found: int | None = self._value("n_max.lifted")
        return found

    @property
    def n_bursts(self) -> int | None:
        """Most consecutive losses, in any order, forever, under which the loop is proved to contract."""
        found: int | None = self._value("n_max.bursts")
        return found

    @property
    def p_mean_square(self) -> float | None:
        """Probability of independent losses below which E[e^2] dies out."""
        found: float | None = self._value("p_max.mean_square")
        return found

    @property
    def p_almost_sure(self) -> float | None:
        """Probability of independent losses below which almost every run converges."""
        found: float | None = self._value("p_max.almost_sure")
        return found

    @property
    def burst_mean_square(self) -> float | None:
        """Mean burst [slots] at the uplink's loss rate, below which E[e^2] dies out."""
        found: float | None = self._value("burst_max.mean_square")
        return found

    @property
    def delay(self) -> float | None:
        """Largest constant delay of the pose [s] on a straight track at the top speed, between samples too."""
        found: float | None = self._value("delay_margin")
        return found

    @property
    def both_links(self) -> float | None:
        """Growth (logarithm, per step) of E[e^2] with both links as they are; None unless commands are lost."""
        found: float | None = self._value("both_links.mean_square_growth")
        return found

    @property
    def loss_rate(self) -> float | None:
        """Loss rate of the scenario's uplink, None for a channel without a closed form."""
        found: float | None = self._extra("loss_rate")
        return found

    @property
    def binding(self) -> str | None:
        """Which error the bursts blow up first: `along` the track or `across` it."""
        found: str | None = self._extra("binding")
        return found

    def _value(self, name: str) -> Any:
        return self.found[name].value if name in self.found else None

    def _extra(self, name: str) -> Any:
        return next((margin.extra[name] for margin in self.found.values() if name in margin.extra), None)

    @property
    def recommendation(self) -> str:
        """Which loss rate to design with, and why; empty where there is none to choose from."""
        square, sure, twins = self.p_mean_square, self.p_almost_sure, self._value("p_max.twins")
        if square is None:
            return ""
        if twins is not None and twins < square:
            return (
                f"a loss rate below {twins:.3g}, up to which most simulated runs converge: the mean square of small "
                f"errors dies out up to {square:.4g}, but the loop's errors do not stay small"
            )
        others = [f"almost every run converges up to {sure:.4g} to first order"] if sure and sure > square else []
        others += [] if twins is None else [f"most simulated runs converge up to {twins:.3g}"]
        beyond = f"; {', '.join(others)}, but there rare long outages decide how far the AGV goes" if others else ""
        guaranteed = (
            ""
            if self.n_bursts is None or self.n_bursts < 1
            else (
                f"; if the link guarantees outages of at most {counted(self.n_bursts, 'slot')}, the loss rate "
                "does not matter"
            )
        )
        return f"the mean square, independent losses below {square:.4g}{beyond}{guaranteed}"

    def disagreements(self) -> list[str]:
        """A sentence for each pair of criteria that say different things."""
        found = []
        if self.n_lifted is not None and (self._paper_has_no_bound or (self.n_paper or -1) > self.n_lifted):
            said = "any number" if self.n_paper is None else str(self.n_paper)
            found.append(
                f"the paper's test allows {said} lost updates in a row; a pose that is always "
                f"{counted(self.n_lifted + 1, 'step')} old makes the error grow"
            )
        if self.n_paper is not None and self.n_bursts is not None and self.n_paper < self.n_bursts:
            found.append(
                "the paper's test calls the loop unstable "
                + ("even without outages" if self.n_paper < 0 else f"beyond {counted(self.n_paper, 'outage')}")
                + f"; it contracts under any outages of up to {counted(self.n_bursts, 'slot')}"
            )
        if self.n_lifted is not None and self.n_bursts is not None and self.n_bursts > self.n_lifted:
            found.append(
                f"outages of up to {counted(self.n_bursts, 'slot')} are survived, since a fresh pose follows "
                "each; a pose that is "
                f"always {counted(self.n_lifted + 1, 'step')} old is not"
            )
        p_square, p_sure = self.p_mean_square, self.p_almost_sure
        if p_square is not None and p_sure is not None and p_sure > p_square:
            found.append(
                f"at loss rates between {p_square:.4f} and {p_sure:.4f} of independent losses almost every run "
                "converges, but the mean square of the error grows: rare long outages dominate it"
            )
        return [*found, *self._against_twins()]

    def _against_twins(self) -> Iterator[str]:
        """A sentence if simulated twins of this very scenario do not contract although E[e^2] dies out under it."""
        growing = [
            margin.value for name, margin in self.found.items() if name.endswith(GROWTH) and margin.value is not None
        ]
        if self.twins is None or not growing or self.twins.mostly_contracting or not self.twins.is_long_enough:
            return
        if max(growing) * (self.twins.steps or 1) > -_PLAIN:
            return  # too short a run for E[e^2] to die out
        yield (
            "with the links as they are a small error dies out in mean square, but neighbouring trajectories "
            f"converge in {self.twins.contracting} of {len(self.twins.contraction)} simulated runs: far from its "
            "reference the loop is not the linear one"
        )

    def _twins_to_json(self) -> dict[str, Any]:
        if self.twins is None:
            return {}
        return {"empirical": {**self.twins.to_json(), "different_runs": self.twins.different}}

    @property
    def _paper_has_no_bound(self) -> bool:
        return self.n_paper is None and self.reasons.get("n_max.paper", "").startswith("no bound")

    def rows(self) -> Iterator[tuple[str, str]]:
        """Name and value of each margin that is worth a row, as text."""
        yield from ((margin.label, margin.words) for margin in self.found.values() if margin.shown)

    def to_json(self) -> dict[str, Any]:
        """The margins by name, beside each that is null its reason."""
        tree: dict[str, Any] = {}
        for name, margin in self.found.items():
            place, _, key = name.rpartition(".")
            values = tree.setdefault(place, {}) if place else tree
            if name not in margin.extra:
                values[key] = margin.value
                if margin.reason:
                    values[f"{key}_reason"] = margin.reason
            tree.update(margin.extra)
        return {
            **tree,
            "feasible": not self.infeasible,
            "infeasible_reason": self.infeasible or None,
            "notes": list(self.notes),
            "left_out": list(self.left_out),
            "recommendation": self.recommendation or None,
            "disagreements": self.disagreements(),
            **self._twins_to_json(),
        }


def margins(scenario: Scenario) -> Margins:
    """Margins of a scenario over one lap of its track. Raises TrackFileError if the track's file cannot be used.

    They are those of the loop linearised about its nominal motion: a limit on the speed bounds what is unstable, it
    does not stabilise it. A loop that does not settle even without losses has none.
    """
    facts = ScenarioFacts(scenario)
    found = {margin.name: margin for criterion in CRITERIA for margin in _margins_of(criterion, facts)}
    notes = () if facts.infeasible else (*facts.loop.active_limits, *facts.loop.not_differentiable)
    return Margins(found, facts.infeasible, notes, left_out(scenario))


def _margins_of(criterion: Criterion, facts: ScenarioFacts) -> Iterator[Margin]:
    """The margins of a criterion; for a loop that does not settle one without a value, under the criterion's name."""
    try:
        yield from criterion.margins(facts)
    except NoNominalMotionError as error:
        for name, label in criterion.margin_names:
            yield Margin(name, label, None, reason=f"no answer: {error}")


def left_out(scenario: Scenario) -> tuple[str, ...]:
    """What a scenario has and no criterion but the empirical one knows, each as `node.parameter is value`."""
    plant, usual = as_dict(scenario.plant), as_dict(PlantParameters())
    found = [f"plant.{name} is {plant[name]}" for name in _UNKNOWN_TO_CRITERIA if plant[name] != usual[name]]
    links = {"uplink": scenario.relay.uplink, "downlink": scenario.relay.downlink}
    found += [
        f"relay.{link}.{name} is {value}"
        for link, channel in links.items()
        for name in ("delay", "jitter", "lifetime", "schedule")
        if (value := getattr(channel, name)) != getattr(ChannelParameters(), name)
    ]
    return tuple(found)
