"""CasADi's dynamics and rows against Pinocchio's and the compiled ones."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import load_problem, load_robot
from ppcbf_robots.symbolic import forward_dynamics, safety_rows


@pytest.mark.parametrize("name", ["cartpole", "two_link", "ur5", "kinova"])
def test_forward_dynamics_agree_with_aba(name):
    robot = load_robot(name)
    model, rng = robot.model, np.random.default_rng(0)
    data, a = model.model.createData(), forward_dynamics(model)
    for angles in robot.domain.sample_q(rng, 50):
        v, u = rng.normal(size=model.nv), model.u_max * rng.uniform(-1.0, 1.0, model.nv)
        expected = pin.aba(model.model, data, model.from_angles(angles), v, u)
        np.testing.assert_allclose(a(angles, v, u).full()[:, 0], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("robot", "world"), [("cartpole", "wall"), ("two_link", "circle"), ("ur5", "five_spheres")])
def test_rows_agree_with_the_safety_function(robot, world):
    problem = load_problem(robot, world)
    rng, h = np.random.default_rng(0), safety_rows(problem.safety)
    for angles in problem.robot.domain.sample_q(rng, 20):
        dyn = problem.model.evaluate(problem.model.from_angles(angles), np.zeros(problem.model.nv))
        np.testing.assert_allclose(h(angles).full()[:, 0], problem.safety.evaluate(dyn).h, atol=1e-12)


def test_other_obstacles_are_refused():
    with pytest.raises(InputError, match="'table' is neither"):
        safety_rows(load_problem("two_link", "table_boxes").safety)
