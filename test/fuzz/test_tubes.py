"""The search for runs that leave their tube finds none, and finds some of a tube that is too narrow."""

from __future__ import annotations

import dataclasses

import numpy as np

from fuzz.tubes import Search


def test_runs_stay_in_their_tube_and_leave_a_narrower_one() -> None:
    one = Search("hold", "line", np.random.default_rng(1))
    for _ in range(6):
        one.go_on()
    assert (one.case.runs, one.case.outside) == (1200, 0)
    assert 0.8 < one.case.nearest <= 1.0
    one.tube = dataclasses.replace(one.tube, bounds=0.5 * one.tube.bounds)
    one.go_on()
    assert one.case.outside > 0
