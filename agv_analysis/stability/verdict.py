"""One word on a recorded loop: asymptotic, mean-square, bounded or unstable; what decided it, and what is left.

The criteria are asked from the strongest statement to the weakest:

- `asymptotic`: whatever outages no longer than the longest of the run come, the error dies out (bursts);
- `mean-square`: under the channel fitted to the run, E[e^2] dies out, though some sequence of outages would not be
  survived;
- `bounded`: neither, but the speed is limited, which makes a bounded limit cycle of what would otherwise grow;
- `unstable`: neither, and nothing bounds the error.

Where commands were lost as well, no sequence of outages is proved to be survived: E[e^2] under both fitted channels
decides. Outages end with a fresh pose; where messages are late none is. A constant delay is judged by the lifted
system, any other is `unknown`.

The Floquet multiplier of the run's own sequence of losses stands beside the verdict and does not enter it: it says what
those losses did to a small error in that one run. Where the mean square grows, most runs may still contract; and a run
that is short, or ends inside an outage, may have a multiplier above 1 in a loop that contracts under any such outages.
"""

from __future__ import annotations

from dataclasses import dataclass

ASYMPTOTIC, MEAN_SQUARE, BOUNDED, UNSTABLE = "asymptotic", "mean-square", "bounded", "unstable"
UNKNOWN = "unknown"
"""For a run that no criterion here covers."""
INFEASIBLE = "infeasible"
"""For a loop that does not settle even without losses."""


@dataclass(frozen=True)
class Verdict:
    """The word, the criterion behind it, and the margin in words."""

    word: str
    criterion: str
    margin: str


def judge(n: int, n_bursts: int | None, mean_square_growth: float, burst_left: float | None, v_max: float) -> Verdict:
    """Verdict on a run.

    n: the longest outage seen [slots]; n_bursts: the longest that is proved to be survived in any order (None: all);
    mean_square_growth: growth (logarithm, per step) of E[e^2] under the fitted channel; burst_left: by what factor its
    mean burst may grow before that is positive (None: unknown or without bound); v_max: limit on the speed [m/s].
    """
    if n_bursts is None or n <= n_bursts:
        left = "any number of" if n_bursts is None else str(n_bursts - n)
        return Verdict(ASYMPTOTIC, "bursts", f"{left} more consecutive outage{'s' if left != '1' else ''}")
    beyond = f"the longest outage exceeds what any sequence of outages may have by {n - n_bursts}"
    if mean_square_growth < 0.0:
        left = "" if burst_left is None else f"; outages may become {burst_left:.3g} times as long on average"
        return Verdict(MEAN_SQUARE, "mean_square", beyond + left)
    if v_max < float("inf"):
        return Verdict(BOUNDED, "v_max", f"none: {beyond}; only the limit on the speed bounds the error")
    return Verdict(UNSTABLE, "mean_square", f"none: {beyond}, and under the fitted channel the mean square grows")


def judge_infeasible(why: str) -> Verdict:
    """Verdict on a loop that does not settle even without losses: there is no motion about which it could be stable."""
    return Verdict(INFEASIBLE, "nominal_motion", f"none: {why}")


def judge_late(n: int | None, radius: float, v_max: float) -> Verdict:
    """Verdict on a run in which messages were late.

    n: the constant outdatedness of the pose [slots], None if it was not constant or commands were late as well; radius:
    spectral radius of the lifted system for it; v_max: limit on the speed [m/s].
    """
    if n is None:
        return Verdict(UNKNOWN, "none", "unknown: messages were late, by no constant delay, which no criterion covers")
    if radius < 1.0:
        return Verdict(
            ASYMPTOTIC, "lifted", f"each pose is {n} steps old, and the error shrinks; see n_max of stability"
        )
    late = f"none: each pose is {n} steps old, and the error grows"
    if v_max < float("inf"):
        return Verdict(BOUNDED, "v_max", f"{late}; only the limit on the speed bounds it")
    return Verdict(UNSTABLE, "lifted", late)


def judge_both_links(growth: float | None, policy: str, v_max: float) -> Verdict:
    """Verdict on a run in which commands were lost.

    growth: that of E[e^2] (logarithm, per step) under the channels fitted to both links, None if it is not computed for
    this downlink policy; v_max: limit on the speed [m/s].
    """
    if growth is None:
        return Verdict(
            UNKNOWN, "none", f"unknown: commands were lost, and no criterion covers downlink policy {policy}"
        )
    if growth < 0.0:
        dies_out = "the mean square of the error dies out" if policy == "hold" else "the error stays bounded on average"
        return Verdict(MEAN_SQUARE, "both_links", f"commands were lost as well; under both fitted channels {dies_out}")
    grows = "none: commands were lost as well, and under both fitted channels the mean square grows"
    if v_max < float("inf"):
        return Verdict(BOUNDED, "v_max", f"{grows}; only the limit on the speed bounds the error")
    return Verdict(UNSTABLE, "both_links", grows)
