"""Eigenvalues that the report draws: the paper's along a run, and the multipliers of the lifted system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Run
from agv_analysis.stability import lifted, paper
from agv_analysis.stability.analysis import Analysis
from agv_analysis.stability.criteria.paper_test import applies_to, paper_inputs
from agv_analysis.stability.scenario_loop import loop_of_run

LARGEST_LIFTED = 600
"""Multipliers of a larger lifted system are not computed: 3 (n + 1) of them take its cube in time."""

_EIGENVALUE_STEPS = 400


def paper_eigenvalues(run: Run) -> NDArray[np.complex128]:
    """Eigenvalues of A(k) (eq. 21) at up to 400 steps of a run, evenly spread, shape (M,); none where it diverged."""
    if not applies_to(run.scenario):
        return np.empty(0, dtype=np.complex128)
    some = np.unique(np.linspace(0, len(run) - 1, _EIGENVALUE_STEPS).astype(np.int64))
    theta, theta_held, v_held = (values[some] for values in paper_inputs(run))
    matrices = paper.matrices(theta, theta_held, v_held, run.scenario.controller, run.ts)
    usable = np.isfinite(matrices).all(axis=(1, 2))
    return np.asarray(np.linalg.eigvals(matrices[usable]).ravel(), dtype=np.complex128)


def lifted_multipliers(analysis: Analysis) -> NDArray[np.complex128]:
    """Eigenvalues of the lifted system at the speeds where it is worst, shape (m + q n,); none if it is too large."""
    loop, n = loop_of_run(analysis.run), analysis.n
    if loop.size + loop.outputs * n > LARGEST_LIFTED:
        return np.empty(0, dtype=np.complex128)
    companion = lifted.companion(loop.frozen(lifted.worst_step(loop, n)), n)
    return np.asarray(np.linalg.eigvals(companion), dtype=np.complex128)
