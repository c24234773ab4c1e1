"""The loop's matrices: what follows from them, what is reachable, and the closed form of the canonical one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from agv_analysis.scenario import load_scenario
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.linearisation import step_matrices
from agv_analysis.stability.scenario_loop import loop_on_lap
from agv_cloud.parameters import ControllerParameters
from test.agv_analysis.stability.general_loops import KINDS, lagged_loop, random_loop, step

TS = 0.005


@pytest.mark.parametrize(("v", "w"), [(1.0, 0.0), (0.0, 0.3), (0.0, 0.0), (-1.0, 0.2)])
def test_reach_is_the_rank_of_what_commands_do(v: float, w: float) -> None:
    """Rank of (B, F B, F^2 B), where B holds the columns by which v and w - w_r move the error where gains act."""
    F, G = (M[0] for M in step_matrices(np.array([v]), np.array([w]), ControllerParameters(), TS))
    rank = np.linalg.matrix_rank(np.hstack((G, F @ G, F @ F @ G)), tol=1e-12)
    assert kanayama_loop(np.array([v]), np.array([w]), ControllerParameters(), TS).size == rank


def test_constant_speeds() -> None:
    def is_constant(v: list[float], w: list[float]) -> bool:
        return kanayama_loop(np.array(v), np.array(w), ControllerParameters(), TS).is_constant

    assert is_constant([1.0] * 4, [0.2] * 4)
    assert not is_constant([1.0, 1.0 + 1e-15], [0.0, 0.0])
    assert not is_constant([1.0, 1.0], [0.0, 1e-12])


@pytest.mark.parametrize("kind", KINDS)
def test_the_short_form_is_the_definition(kind: str) -> None:
    """z' = F z + G h and h' = H h + K z, of random z and h; innovations are what the model misses."""
    loop = random_loop(kind, 4, 4)
    random = np.random.default_rng(1)
    z, h = random.standard_normal((loop.size, 1)), random.standard_normal((loop.outputs, 1))
    for k in range(4):
        z_next, h_next = step(loop, k, z, h, received=False)
        np.testing.assert_allclose(loop.F[k] @ z + loop.G[k] @ h, z_next, atol=1e-14)
        if loop.H is None:
            np.testing.assert_array_equal(h_next, h)
            assert loop.innovation is None
            continue
        K = 0.0 if loop.K is None else loop.K[k] @ z
        np.testing.assert_allclose(loop.H[k] @ h + K, h_next, atol=1e-14)
        assert loop.P_h is not None
        assert loop.innovation is not None
        u = loop.L_h[k] @ h + loop.L_z[k] @ z
        missed = z_next[: loop.outputs] - loop.P_h[k] @ z[: loop.outputs] - loop.P_u[k] @ u  # type: ignore[index]
        np.testing.assert_allclose(loop.innovation[0][k] @ z + loop.innovation[1][k] @ h, missed, atol=1e-14)


def test_the_speed_scale_is_in_the_plant_and_not_in_the_model() -> None:
    v, w = np.array([1.0, 2.0]), np.array([0.1, -0.3])
    F, G = step_matrices(v, w, ControllerParameters(), TS)
    loop = kanayama_loop(v, w, ControllerParameters(), TS, True, 1.3)
    np.testing.assert_allclose(loop.G, G * [1.3, 1.0, 1.0], rtol=1e-15)
    assert loop.H is not None
    np.testing.assert_allclose(loop.H, F + G, rtol=1e-15)
    assert not loop.is_exact
    assert loop.along_gain == pytest.approx(1.3 * 0.125)
    assert kanayama_loop(v, w, ControllerParameters(), TS, True).is_exact
    assert not kanayama_loop(v, w, ControllerParameters(), TS).is_exact


def test_a_scenario_knows_its_speed_scale_and_policy() -> None:
    settings = ["plant.speed_scale=1.3", "error_detector.track=line", "error_detector.policy=predict"]
    loop = loop_on_lap(load_scenario("config/paper.yaml", settings))
    assert (loop.steps, loop.is_constant, loop.predicts) == (20_000, True, True)
    assert loop.G[0, 0, 0] == pytest.approx(-0.125 * 1.3, rel=1e-12)


def test_along_a_lag_hides_the_gain() -> None:
    one = np.ones(1), np.zeros(1)
    assert lagged_loop(*one, ControllerParameters(), 0.1).along_gain is None
    plain = dataclasses.replace(kanayama_loop(*one, ControllerParameters(), TS), closed_form=None)
    assert plain.along_gain == pytest.approx(0.125)
    assert plain.without_along().size == 2


def test_some_steps_of_a_lap() -> None:
    loop = random_loop("predicted with memory", 6, 6)
    part = loop.at(np.array([4, 1]))
    np.testing.assert_array_equal(part.F, loop.F[[4, 1]])
    np.testing.assert_array_equal(part.K, loop.K[[4, 1]])  # type: ignore[index]
    alike = random_loop("held", 6, 1).at(np.arange(2, 6))
    assert (alike.steps, alike.is_constant) == (4, True)
    assert loop.frozen(3).is_constant


def test_wrong_shapes_are_refused() -> None:
    loop = random_loop("held", 6, 6)
    with pytest.raises(ValueError, match=r"L_z must have the shape \(6, 2, 5\)"):
        dataclasses.replace(loop, L_z=loop.L_h)
    with pytest.raises(ValueError, match="belong together"):
        dataclasses.replace(loop, P_h=loop.A)
    with pytest.raises(ValueError, match="1 row or one for each of 5 steps"):
        dataclasses.replace(loop, v_r=np.ones(5), w_r=np.ones(5))
