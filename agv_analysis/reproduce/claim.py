"""A claim: where it stands, how it is measured and judged, and the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from agv_analysis.reproduce.runs import Runs

HOLDS = "holds"
REMARK = "holds with a remark"
PART = "holds in part"
FAILS = "does not hold"

Values = dict[str, Any]
"""What was measured by name, with its unit: numbers, texts, None for what did not happen."""


class Judgement(NamedTuple):
    """A verdict, and what a reader must know beside it."""

    verdict: str
    remark: str = ""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper."""

    key: str
    where: str
    """Section of the paper."""
    text: str
    measure: Callable[[Runs], Values]
    judge: Callable[[Values], Judgement]


@dataclass(frozen=True)
class Finding:
    """A claim with what was measured and the verdict."""

    claim: Claim
    measured: Values
    judgement: Judgement


def check(claim: Claim, runs: Runs) -> Finding:
    """Measure a claim and judge it."""
    measured = claim.measure(runs)
    return Finding(claim, measured, claim.judge(measured))


def holds_if(condition: bool, remark: str = "") -> Judgement:
    """Holds under the condition, with the remark if there is one; does not hold otherwise."""
    if not condition:
        return Judgement(FAILS, remark)
    return Judgement(REMARK if remark else HOLDS, remark)
