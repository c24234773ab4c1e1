"""What a run says: outages, convergence, and whether the loop is stable by three criteria that need not agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.convergence import Convergence, convergence
from agv_analysis.outages import Outages, outages
from agv_analysis.run import Run
from agv_analysis.stability import bursts, lifted, paper
from agv_analysis.stability.bursts import BurstVerdict


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


@dataclass(frozen=True)
class Analysis:
    """A run and what follows from it."""

    run: Run
    outages: Outages
    convergence: Convergence
    paper: PaperTest
    lifted_radius: float
    """Largest spectral radius of the lifted system over the track, for a pose as old as the oldest of the run."""
    bursts: BurstVerdict
    """Verdict for arbitrary bursts of up to as many lost poses as the longest outage of the run."""

    @property
    def n(self) -> int:
        """The outdatedness that the stability criteria are asked about: the largest n_ul of the run."""
        return self.outages.n_ul_max

    @property
    def lifted_stable(self) -> bool:
        """Does the loop contract if every pose is as old as the oldest of the run?"""
        return self.lifted_radius < 1.0

    @property
    def bursts_stable(self) -> bool:
        """Is the loop proved to contract for every sequence of outages no longer than the longest of the run?"""
        return self.bursts.verdict == bursts.STABLE

    def disagreements(self) -> list[str]:
        """A sentence for each pair of criteria that say different things."""
        found = []
        if self.paper.stable and not self.lifted_stable:
            found.append(
                f"the paper's test calls the loop stable, but a pose that is always {self.n} steps old makes the "
                f"error grow by a factor {self.lifted_radius:.4f} a step: the test takes the outdated pose for the "
                "current one"
            )
        if self.paper.stable and self.bursts.verdict == bursts.UNSTABLE:
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
        """The figures by name, for `--json`; steps count from the run's first, SI units; null: the run cannot say."""
        run, up, down = self.run, self.outages.uplink, self.outages.downlink
        return {
            "source": run.source,
            "steps": len(run),
            "ts": run.ts,
            "seed": run.scenario.relay.seed,
            "valid": not run.unexplained,
            "unexplained": dict(run.unexplained),
            "notes": list(run.notes),
            "loss_rate": up.loss_rate,
            "n_ul_max": self.n,
            "n_ul_mean": up.age.mean,
            "n_ul_p99": up.age.p99,
            "mean_burst": up.mean_burst,
            "outage_lengths": {str(length): count for length, count in up.histogram.items()},
            "downlink_loss_rate": down.loss_rate,
            "settle_1cm_steps": self.convergence.settle_1cm_steps,
            "settle_2pct_steps": self.convergence.settle_2pct_steps,
            "overshoot": self.convergence.overshoot,
            "damping": self.convergence.damping,
            "final_error": _finite(self.convergence.position.final),
            "max_error": _finite(self.convergence.position.peak),
            "iae": _finite(self.convergence.y.iae),
            "ise": _finite(self.convergence.y.ise),
            "paper_stable": self.paper.stable,
            "paper_radius": _finite(self.paper.radius),
            "lifted_stable": self.lifted_stable,
            "lifted_radius": _finite(self.lifted_radius),
            "bursts_stable": self.bursts_stable,
            "bursts_verdict": self.bursts.verdict,
            "bursts_radius_lower": _finite(self.bursts.lower),
            "bursts_radius_upper": _finite(self.bursts.upper),
            "disagreements": self.disagreements(),
        }


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None


def analyse(run: Run) -> Analysis:
    """Analysis of a run, recorded or simulated. Raises UserError if the run has no step."""
    out = outages(run)
    v_r, w_r, gains = run.reference[:, 3], run.reference[:, 4], run.scenario.controller
    return Analysis(
        run=run,
        outages=out,
        convergence=convergence(run),
        paper=paper_test(run),
        lifted_radius=lifted.largest_radius(out.n_ul_max, v_r, w_r, gains, run.ts),
        bursts=bursts.verdict(out.n_ul_max, v_r, w_r, gains, run.ts),
    )


def paper_test(run: Run) -> PaperTest:
    """The paper's test (eq. 55, 56) with the headings, speeds and outages of a run.

    Where the pose that the edge held is missing from the recording the oldest one before it stands for it.
    """
    held = np.clip(np.searchsorted(run.k, run.k - run.n_ul), 0, len(run) - 1)
    theta = run.pose[:, 2]
    radii = paper.spectral_radii(theta, theta[held], run.reference[held, 3], run.scenario.controller, run.ts)
    worst = int(np.argmax(radii))
    return PaperTest(float(radii[worst]), int(run.k[worst]))
