"""What a run says: outages, convergence, whether the loop is stable by criteria that need not agree, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.link.channel_fit import ChannelFit, fit_channel
from agv_analysis.metrics.convergence import Convergence, convergence
from agv_analysis.metrics.outages import Outages, loss_causes, outages
from agv_analysis.run import Floats, LinkSlots, Run
from agv_analysis.stability import (
    floquet,
    joint_spectral_radius,
    lifted,
    mean_square,
    mean_square_two_links,
    paper,
    variable_delay,
)
from agv_analysis.stability.joint_spectral_radius import BurstVerdict
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.margins import LONGEST, LONGEST_PREDICTED
from agv_analysis.stability.scenario_loop import loop_of_run
from agv_analysis.stability.verdict import Verdict, judge, judge_both_links, judge_late
from agv_ros.errors import UserError


@dataclass(frozen=True)
class PaperTest:
    """The paper's test along a run: is the spectral radius of A(k) below 1 at every step?"""

    radius: float
    """The largest spectral radius."""
    k: int
    """The step that has it."""

    @property
    def stable(self) -> bool:
        """The paper's verdict."""
        return self.radius < 1.0


GAINS_UNKNOWN = "the controller's gains are not known: name its params file with --config"

_OF_GAINS = (
    "paper_stable", "paper_radius", "lifted_stable", "lifted_radius", "bursts_stable", "bursts_verdict",
    "bursts_radius_lower", "bursts_radius_upper", "mean_square_stable", "mean_square_growth",
    "floquet_multiplier_per_step", "contraction_per_step", "verdict", "verdict_criterion", "margin",
)  # fmt: skip
"""Figures that nobody knows without the gains."""


@dataclass(frozen=True)
class Observations:
    """A run and what can be seen in it, whatever the controller's gains were."""

    run: Run
    outages: Outages
    convergence: Convergence
    fit: ChannelFit
    """The uplink as fitted to the run."""

    @property
    def n(self) -> int:
        """The outdatedness that the stability criteria are asked about: the largest n_ul of the run."""
        return self.outages.n_ul_max

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
            "n_ul_max": self.n,
            "n_ul_mean": up.age.mean,
            "n_ul_p99": up.age.p99,
            "mean_burst": up.mean_burst,
            "outage_lengths": {str(length): count for length, count in up.histogram.items()},
            "loss_causes": loss_causes(run.uplink),
            "downlink_loss_rate": down.loss_rate,
            "downlink_loss_causes": loss_causes(run.downlink),
            "settle_1cm_steps": self.convergence.settle_1cm_steps,
            "settle_2pct_steps": self.convergence.settle_2pct_steps,
            "overshoot": self.convergence.overshoot,
            "damping": self.convergence.damping,
            "final_error": _finite(self.convergence.position.final),
            "max_error": _finite(self.convergence.position.peak),
            "iae": _finite(self.convergence.y.iae),
            "ise": _finite(self.convergence.y.ise),
            "channel_fit": _fit_to_json(self.fit),
            **dict.fromkeys(_OF_GAINS),
            "no_verdict_because": None if run.gains_known else GAINS_UNKNOWN,
            "disagreements": self.disagreements(),
        }


@dataclass(frozen=True)
class Analysis(Observations):
    """A run and what follows from it and from the controller's gains."""

    paper: PaperTest
    lifted_radius: float
    """Largest spectral radius of the lifted system over the track, for a pose as old as the oldest of the run.

    As if it were fresh where it is predicted exactly; that of the whole run, per step, where the model is wrong.
    """
    bursts: BurstVerdict
    """Verdict for arbitrary bursts of up to as many lost poses as the longest outage of the run."""
    mean_square_growth: float
    """Growth (logarithm, per step) of E[e^2] under the fitted channel, or both of them where commands were lost."""
    floquet: float | None
    """Growth factor per step of a small error under the run's own sequence of losses; None where steps are missing."""
    contraction: float | None
    """The same about the motion that was driven, measured on the recorded poses."""
    verdict: Verdict

    @property
    def lifted_stable(self) -> bool:
        """Does the loop contract if every pose is as old as the oldest of the run?"""
        return self.lifted_radius < 1.0

    @property
    def bursts_stable(self) -> bool:
        """Is the loop proved to contract for every sequence of outages no longer than the longest of the run?"""
        return self.bursts.verdict == joint_spectral_radius.STABLE

    def disagreements(self) -> list[str]:
        """A sentence for each pair of criteria that say different things."""
        found = []
        if self.paper.stable and not self.lifted_stable:
            found.append(
                f"the paper's test calls the loop stable, but a pose that is always {self.n} steps old makes the "
                f"error grow by a factor {self.lifted_radius:.4f} a step: the test takes the outdated pose for the "
                "current one"
            )
        if self.paper.stable and self.bursts.verdict == joint_spectral_radius.UNSTABLE:
            found.append(
                f"the paper's test calls the loop stable, but outages of {self.bursts.worst} slots in a row, again and "
                f"again, make the error grow by a factor {self.bursts.lower:.4f} a step"
            )
        if not self.paper.stable and self.bursts_stable:
            found.append(
                f"the paper's test calls the loop unstable (|lambda| = {self.paper.radius:.6g} at step "
                f"{self.paper.k}), but it contracts under any outages of up to {self.n} slots"
            )
        if self.bursts_stable and not self.lifted_stable:
            found.append(
                f"outages of up to {self.n} slots are survived, since a fresh pose follows each; a pose that is always "
                f"{self.n} steps old is not"
            )
        return found

    def to_json(self) -> dict[str, Any]:
        """The figures by name, as `Observations.to_json`."""
        return {
            **super().to_json(),
            "paper_stable": self.paper.stable,
            "paper_radius": _finite(self.paper.radius),
            "lifted_stable": self.lifted_stable,
            "lifted_radius": _finite(self.lifted_radius),
            "bursts_stable": self.bursts_stable,
            "bursts_verdict": self.bursts.verdict,
            "bursts_radius_lower": _finite(self.bursts.lower),
            "bursts_radius_upper": _finite(self.bursts.upper),
            "mean_square_stable": self.mean_square_growth < 0.0,
            "mean_square_growth": _finite(self.mean_square_growth),
            "floquet_multiplier_per_step": self.floquet,
            "contraction_per_step": self.contraction,
            "verdict": self.verdict.word,
            "verdict_criterion": self.verdict.criterion,
            "margin": self.verdict.margin,
        }


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None


def observe(run: Run) -> Observations:
    """What can be seen in a run, be its gains known or not. Raises UserError if the run has no step."""
    return Observations(run=run, outages=outages(run), convergence=convergence(run), fit=fit_channel(run.lost))


def analyse(run: Run) -> Analysis:
    """Analysis of a run, recorded or simulated. Raises UserError if the run has no step or its gains are unknown."""
    if not run.gains_known:
        raise UserError(f"{run.source}: {GAINS_UNKNOWN}")
    out, fit = outages(run), fit_channel(run.lost)
    loop, v_max = loop_of_run(run), run.scenario.controller.v_max
    both = _growth_on_both_links(run, fit, loop)
    growth = mean_square.lap_growth(loop, fit.chain) / len(run) if both is None else both
    of_drops, of_motion = _contractions(run, loop)
    radius = lifted.largest_radius(loop, out.n_ul_max)
    if _is_late(run):
        verdict = judge_late(_constant_delay(run), radius, v_max)
    elif run.downlink_lost.any():
        verdict = judge_both_links(both, run.scenario.plant.downlink_policy, v_max)
    else:
        longest = max(out.n_ul_max, LONGEST_PREDICTED) if loop.predicts else LONGEST
        n_bursts, _ = joint_spectral_radius.largest_n(loop, longest)
        verdict = judge(out.n_ul_max, n_bursts, growth, _burst_left(fit, growth, loop), v_max)
    return Analysis(
        run=run,
        outages=out,
        convergence=convergence(run),
        paper=paper_test(run),
        lifted_radius=radius,
        bursts=joint_spectral_radius.verdict(loop, out.n_ul_max),
        fit=fit,
        mean_square_growth=growth,
        floquet=of_drops,
        contraction=of_motion,
        verdict=verdict,
    )


def _growth_on_both_links(run: Run, fit: ChannelFit, loop: LinearLoop) -> float | None:
    """Growth of E[e^2] per step under both fitted channels; None if no command was lost, or for other policies."""
    policy = run.scenario.plant.downlink_policy
    if policy not in mean_square_two_links.POLICIES or not run.downlink_lost.any():
        return None
    links = mean_square_two_links.independent(fit.chain, fit_channel(run.downlink_lost).chain)
    return mean_square_two_links.lap_growth(loop, links, stops=policy == "zero") / len(run)


def _is_late(run: Run) -> bool:
    """Did messages arrive in a later slot than their own?"""
    return _has_late(run.uplink) or _has_late(run.downlink)


def _has_late(link: LinkSlots | None) -> bool:
    return link is not None and bool(link.delay.any())


def _constant_delay(run: Run) -> int | None:
    """Age of the pose in slots, if it is always the same, but for the beginning, and commands are there at once."""
    n = int(run.n_ul.max())
    is_direct = not (run.downlink_lost.any() or _has_late(run.downlink))
    return n if is_direct and np.array_equal(run.n_ul, np.minimum(run.k, n)) else None


def _burst_left(fit: ChannelFit, growth: float, loop: LinearLoop) -> float | None:
    """By what factor the mean burst may grow at the fitted loss rate; None for a fit without bursts."""
    if fit.model != "gilbert_elliott" or growth >= 0.0 or fit.chain.loss_rate >= 1.0:
        return None
    critical = mean_square.critical_burst(loop, fit.chain.loss_rate)
    return critical / fit.mean_burst if np.isfinite(critical) else None


def _contractions(run: Run, loop: LinearLoop) -> tuple[float | None, float | None]:
    """Growth factors per step from the first pose received on: about the reference, and about the driven motion."""
    if _is_late(run):
        return _late_contraction(run, loop), None
    first = int(np.argmin(run.lost))
    steps = len(run) - first
    if run.lost[first] or int(run.k[-1] - run.k[first]) + 1 != steps:
        return None, None
    lost, gains, align = run.lost[first:], loop.closed_form, run.scenario.error_detector.policy == "align"
    with np.errstate(all="ignore"):
        of_drops = floquet.drop_sequence(loop.at(np.arange(first, len(run))), lost, 1)
        of_drops_per_step = _finite(float(np.exp(of_drops[0] / steps)))
        if loop.predicts or gains is None:  # a prediction depends on all commands since the pose, not on it alone
            return of_drops_per_step, None
        of_motion = floquet.trajectory(run.pose[first:], run.reference[first:], lost, gains, run.ts, align)
    return of_drops_per_step, _finite(float(np.exp(of_motion[0] / steps)))


def _late_contraction(run: Run, loop: LinearLoop) -> float | None:
    """Growth factor per step about the reference from the first step on; None for what `variable_delay` cannot say."""
    is_whole = run.k[0] == 0 and int(run.k[-1]) + 1 == len(run)
    if loop.predicts or not is_whole or _has_late(run.downlink):
        return None
    with np.errstate(all="ignore"):
        growth = variable_delay.age_sequence(loop, run.n_ul)
    return _finite(float(np.exp(growth / len(run))))


def _fit_to_json(fit: ChannelFit) -> dict[str, Any]:
    """The fitted channel with the names of the relay's parameters, each with its 95 % interval."""
    estimates = {"loss_rate": fit.loss_rate, "p": fit.p, "r": fit.r}
    return {
        "model": fit.model,
        "p_value": fit.p_value,
        "mean_burst": _finite(fit.mean_burst),
        **{name: None if e is None else [e.value, e.low, e.high] for name, e in estimates.items()},
    }


def paper_test(run: Run) -> PaperTest:
    """The paper's test (eq. 55, 56) with the headings, speeds and outages of a run."""
    radii = paper.spectral_radii(*paper_inputs(run), run.scenario.controller, run.ts)
    worst = int(np.argmax(radii))
    return PaperTest(float(radii[worst]), int(run.k[worst]))


def paper_inputs(run: Run) -> tuple[Floats, Floats, Floats]:
    """What A(k) of eq. 55 depends on at each step: theta_c(k), theta_c(k-n) [rad], v_r(k-n) [m/s], each of shape (N,).

    Where the pose that the edge held is missing from the recording the oldest one before it stands for it.
    """
    held = np.clip(np.searchsorted(run.k, run.k - run.n_ul), 0, len(run) - 1)
    theta = run.pose[:, 2]
    return theta, theta[held], run.reference[held, 3]
