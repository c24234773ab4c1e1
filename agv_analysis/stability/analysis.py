"""What a run says: outages, convergence, whether the loop is stable by criteria that need not agree, and a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agv_analysis.json_values import finite
from agv_analysis.link.channel_fit import ChannelFit, fit_channel
from agv_analysis.metrics.convergence import Convergence, convergence
from agv_analysis.metrics.deviation import Deviation, deviation
from agv_analysis.metrics.outages import Outages, loss_causes, outages
from agv_analysis.run import Run
from agv_analysis.stability.criteria.criterion import Judgement, RunFacts, change_text
from agv_analysis.stability.criteria.paper_test import PaperTest
from agv_analysis.stability.evidence import Judgements, evidence_of_run, verdict_of_run
from agv_analysis.stability.joint_spectral_radius import UNSTABLE, BurstVerdict
from agv_analysis.stability.verdict import Evidence, Verdict
from agv_ros.counted import counted
from agv_ros.errors import UserError

GAINS_UNKNOWN = "the controller's gains are not known: name its params file with --config"

_OF_GAINS = (
    "paper_stable", "paper_radius", "lifted_stable", "lifted_radius", "bursts_stable", "bursts_verdict",
    "bursts_radius_lower", "bursts_radius_upper", "mean_square_stable", "mean_square_growth",
    "floquet_multiplier_per_step", "contraction_per_step", "verdict", "verdict_criterion", "verdict_reason",
    "margin", "feasible", "infeasible_reason", "nominal_notes", "confidence", "growth_interval", "record_seconds_more",
    "stationarity", "driven",
)  # fmt: skip
"""Figures that are unknown without the gains."""


@dataclass(frozen=True)
class Observations:
    """A run and what can be seen in it, whatever the controller's gains were."""

    run: Run
    outages: Outages
    convergence: Convergence
    deviation: Deviation
    fit: ChannelFit
    """The uplink as fitted to the run."""

    @property
    def n(self) -> int:
        """The outdatedness that the stability criteria are asked about: the largest age of a pose that acted."""
        return self.outages.n_max

    def disagreements(self) -> list[str]:
        """None: without gains there are no criteria that could disagree."""
        return []

    def to_json(self) -> dict[str, Any]:
        """The figures by name, for `--json`; steps count from the run's first, SI units; null: the run cannot say."""
        run, up, down = self.run, self.outages.uplink, self.outages.downlink
        return {
            "source": run.source,
            "steps": len(run),
            "ts": run.ts,
            "seed": run.scenario.relay.seed if run.seed_known else None,
            "valid": not run.unexplained,
            "unexplained": dict(run.unexplained),
            "notes": list(run.notes),
            "loss_rate": up.loss_rate,
            "n_ul_max": self.outages.n_ul_max,
            "n_ul_mean": up.age.mean,
            "n_ul_p99": up.age.p99,
            "mean_burst": up.mean_burst,
            "outage_lengths": {str(length): count for length, count in up.histogram.items()},
            "timing": None if run.timing is None else run.timing.to_json(),
            "loss_causes": loss_causes(run.uplink),
            "downlink_loss_rate": down.loss_rate,
            "downlink_loss_causes": loss_causes(run.downlink),
            **self.convergence.to_json(),
            **self.deviation.to_json(),
            "channel_fit": _fit_to_json(self.fit),
            **dict.fromkeys(_OF_GAINS),
            "no_verdict_because": None if run.gains_known else GAINS_UNKNOWN,
            "disagreements": self.disagreements(),
        }


@dataclass(frozen=True)
class Analysis(Observations):
    """A run and what follows from it and from the controller's gains."""

    judgements: Mapping[str, Judgement]
    """What each criterion says, by its key; those that do not apply are absent."""
    verdict: Verdict
    evidence: Evidence
    """What the verdict rests on."""
    infeasible: str = ""
    """Why the loop does not settle even without losses; empty if it does."""
    nominal_notes: tuple[str, ...] = ()
    """Limits that are active on the loss-free motion, and where a step has no derivative."""

    @property
    def paper(self) -> PaperTest | None:
        """The paper's test, None where it does not apply."""
        found: PaperTest | None = self._detail("paper")
        return found

    @property
    def lifted_radius(self) -> float | None:
        """Growth factor per step for a pose as old as the oldest of the run, None where there is no such number."""
        found: float | None = self._detail("lifted")
        return found

    @property
    def bursts(self) -> BurstVerdict | None:
        """For arbitrary bursts of up to as many lost poses as the longest outage of the run."""
        found: BurstVerdict | None = self._detail("bursts")
        return found

    @property
    def mean_square_growth(self) -> float | None:
        """Growth (logarithm, per step) of E[e^2] under the fitted channel, or both where commands were lost."""
        found = self._detail("mean_square")
        return None if found is None else float(found[0])

    @property
    def floquet(self) -> float | None:
        """Growth factor per step of a small error under the run's own losses; None where steps are missing."""
        found: float | None = self._value("recorded_losses", "floquet_multiplier_per_step")
        return found

    @property
    def contraction(self) -> float | None:
        """The same about the motion that was driven, measured on the recorded poses."""
        found: float | None = self._value("recorded_losses", "contraction_per_step")
        return found

    @property
    def lifted_stable(self) -> bool:
        """Does the loop contract if every pose is as old as the oldest?"""
        return self._stable("lifted")

    @property
    def bursts_stable(self) -> bool:
        """Is the loop proved to contract for every sequence of outages no longer than the longest of the run?"""
        return self._stable("bursts")

    def _detail(self, key: str) -> Any:
        return self.judgements[key].detail if key in self.judgements else None

    def _value(self, key: str, name: str) -> Any:
        return self.judgements[key].values.get(name) if key in self.judgements else None

    def _stable(self, key: str) -> bool:
        return key in self.judgements and self.judgements[key].stable is True

    def disagreements(self) -> list[str]:
        """A sentence for each pair of criteria that say different things."""
        found: list[str] = []
        paper = self.paper
        if self.infeasible:
            return found
        lifted = self.lifted_radius
        if paper is not None and paper.stable and not self.lifted_stable and lifted is not None:
            found.append(
                f"the paper's test calls the loop stable, but with a pose that is always {counted(self.n, 'step')} old "
                f"errors grow by {change_text(lifted - 1.0)}: the test takes the outdated pose for the "
                "current one"
            )
        bursts = self.bursts
        if paper is not None and paper.stable and bursts is not None and bursts.verdict == UNSTABLE:
            found.append(
                f"the paper's test calls the loop stable, but under outages of {counted(bursts.worst, 'slot')}, again "
                f"and again, errors grow by {change_text(bursts.lower - 1.0)}"
            )
        if paper is not None and not paper.stable and self.bursts_stable:
            found.append(
                f"the paper's test calls the loop unstable (|lambda| = {paper.radius:.6g} at step "
                f"{paper.k}), but it contracts under any outages of up to {counted(self.n, 'slot')}"
            )
        if self.bursts_stable and not self.lifted_stable:
            found.append(
                f"outages of up to {counted(self.n, 'slot')} are survived, since a fresh pose follows each; a "
                "pose that is always "
                f"{counted(self.n, 'step')} old is not"
            )
        return found

    def to_json(self) -> dict[str, Any]:
        """The figures by name, as `Observations.to_json`."""
        values = {name: value for found in self.judgements.values() for name, value in found.values.items()}
        return {
            **super().to_json(),
            **values,
            **self.evidence.to_json(),
            "driven": None if self.evidence.driven is None else self.evidence.driven.to_json(),
            **self.verdict.to_json(),
            "margin": self.verdict.margin,
            "feasible": not self.infeasible,
            "infeasible_reason": self.infeasible or None,
            "nominal_notes": list(self.nominal_notes),
        }


def observe(run: Run) -> Observations:
    """What can be seen in a run, be its gains known or not. Raises UserError if the run has no step."""
    seen, converged = outages(run), convergence(run)
    return Observations(run, seen, converged, deviation(run, converged.initial), fit_channel(run.lost, run.k))


def analyse(run: Run) -> Analysis:
    """Analysis of a run, recorded or simulated. Raises UserError if the run has no step or its gains are unknown."""
    if not run.gains_known:
        raise UserError(f"{run.source}: {GAINS_UNKNOWN}")
    facts, converged = RunFacts(run), convergence(run)
    judgements = dict(Judgements(facts))
    evidence = evidence_of_run(facts, judgements)
    return Analysis(
        run=run,
        outages=facts.outages,
        convergence=converged,
        deviation=deviation(run, converged.initial),
        fit=facts.fit,
        judgements=judgements,
        verdict=verdict_of_run(facts, evidence),
        evidence=evidence,
        infeasible=facts.infeasible,
        nominal_notes=(*facts.loop.active_limits, *facts.loop.not_differentiable) if facts.is_feasible else (),
    )


def _fit_to_json(fit: ChannelFit) -> dict[str, Any]:
    """The fitted channel with the names of the relay's parameters, each with its 95 % interval."""
    estimates = {"loss_rate": fit.loss_rate, "p": fit.p, "r": fit.r, "mean_age": fit.mean_age}
    return {
        "model": fit.model,
        "p_value": fit.p_value,
        "mean_burst": finite(fit.mean_burst),
        **{name: None if e is None else [*map(finite, (e.value, e.low, e.high))] for name, e in estimates.items()},
        "goodness": fit.goodness.to_json(),
    }
