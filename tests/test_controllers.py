"""Nominal controllers: exact energy balance, bounded springs, and derived gains that fit the torque box."""

from __future__ import annotations

import numpy as np
import pytest

from ppcbf_robots.controllers import Gains, NominalController
from ppcbf_robots.derive import SPRING_RATE, derive_gains
from ppcbf_robots.problem import load_robot
from ppcbf_robots.specs import ControllerSpec

KINDS = ["pd_gravity", "shaping", "bounded_spring"]
DT = 1e-3  # [s], control period the derived gains must suit


@pytest.fixture(params=KINDS)
def controller(request, problem):
    """Each controller on each robot, with damping and springs that the bound cuts."""
    nv = problem.model.nv
    gains = Gains(request.param, np.linspace(5.0, 9.0, nv), np.linspace(0.5, 1.0, nv), np.linspace(2.0, 3.0, nv))
    return NominalController(problem.model, gains, problem.robot.goal)


def test_storage_falls_by_the_dissipation(problem, controller, states, along_motion):
    """dV/dt = -d_p along the robot's motion under u_des."""
    model, dt = problem.model, 1e-6
    for q, v in states(problem, 20):
        now = controller.evaluate(model.evaluate(q, v))
        a = model.acceleration(q, v, now.u)
        before, after = (controller.evaluate(dyn) for dyn in along_motion(model, q, v, a, dt))
        assert (after.V - before.V) / (2 * dt) == pytest.approx(-now.d_p, rel=1e-4, abs=1e-5)
        assert now.d_p == pytest.approx(v @ (controller.gains.kd * v))


def test_potential_is_least_at_the_goal(problem, controller, states):
    model = problem.model
    assert controller.spring(problem.robot.goal)[1] == 0.0
    at_goal = controller.evaluate(model.evaluate(problem.robot.goal, np.zeros(model.nv)))
    assert float(at_goal.V) == pytest.approx(0.0, abs=1e-12)
    if controller.gains.kind != "shaping":  # whose gravity potential is lowest elsewhere
        potentials = [controller.evaluate(model.evaluate(q, 0.0 * v)).V for q, v in states(problem, 50)]
        assert min(potentials) > 0.0


def test_the_papers_cartpole_storage_is_positive(cartpole, states):
    controller = cartpole.robot.controller
    assert controller.gains.kind == "shaping"
    for q, v in states(cartpole, 50):
        nominal = controller.evaluate(cartpole.model.evaluate(q, v))
        np.testing.assert_allclose(nominal.u, [-(q[0] - 1.0), 0.0], atol=1e-12)
        kinetic = v[0] ** 2 + v[0] * v[1] * np.cos(q[1]) + 0.5 * v[1] ** 2
        assert float(nominal.V) == pytest.approx(kinetic + 9.81 * (1 - np.cos(q[1])) + 0.5 * (q[0] - 1.0) ** 2)
        assert nominal.d_p == 0.0
        assert nominal.V > 0.0


def test_bounded_spring_never_exceeds_its_bound(problem):
    model = problem.model
    bound = np.linspace(2.0, 3.0, model.nv)
    gains = Gains("bounded_spring", np.full(model.nv, 1e4), np.zeros(model.nv), bound)
    controller = NominalController(model, gains, problem.robot.goal)
    far = np.random.default_rng(0).uniform(-50.0, 50.0, (200, model.nv))
    force, potential = controller.spring(model.from_angles(far))
    assert np.all(np.abs(force) <= bound)
    assert np.abs(force[:, ~model.continuous]).min() > 0.99 * bound.min()
    assert np.all(np.isfinite(potential))


def test_springs_turn_without_a_jump(kinova):
    """On a continuous joint the torque is the same just before and just after half a turn."""
    model = kinova.model
    i = int(np.flatnonzero(model.continuous)[0])
    angles = model.to_angles(kinova.robot.goal)
    forces = []
    for turn in (np.pi - 1e-6, np.pi + 1e-6):
        angles_i = angles.copy()
        angles_i[i] += turn
        forces.append(kinova.robot.controller.spring(model.from_angles(angles_i))[0][i])
    assert abs(forces[0] - forces[1]) < 1e-3


def test_batch_equals_single(problem, controller, states):
    if controller.gains.kind == "shaping":
        pytest.skip("its potential comes from Pinocchio, one configuration at a time")
    q, v = (np.array(x) for x in zip(*states(problem, 3), strict=True))
    batch = controller.evaluate(problem.model.evaluate_batch(q, v))
    for i in range(3):
        single = controller.evaluate(problem.model.evaluate(q[i], v[i]))
        for name, value in vars(single).items():
            np.testing.assert_allclose(getattr(batch, name)[i], value, atol=1e-12)


@pytest.mark.parametrize("robot", ["panda", "kinova"])
def test_derived_gains_fit_the_torque_box_and_the_control_period(problems, states, robot):
    problem = problems[robot]
    model = problem.model
    gains = derive_gains(model, None, problem.robot.domain)
    controller, kd = NominalController(model, gains, problem.robot.goal), gains.kd
    for q, v in states(problem, 300, seed=7):
        dyn = model.evaluate(q, v)
        assert np.all(np.abs(controller.evaluate(dyn).u) <= 1.02 * model.u_max)
        assert np.abs(np.linalg.eigvals(dyn.Minv * kd)).max() * DT < 1.0


def test_the_derived_spring_suits_the_damping_that_is_given(panda):
    """A damping ratio of 0.5 on the mean inertia, whichever damping that is; an undamped joint has the derived one."""
    model, domain = panda.model, panda.robot.domain
    own = derive_gains(model, None, domain)
    half = derive_gains(model, ControllerSpec(kd=(0.5 * own.kd).tolist()), domain)
    bent = own.kp < SPRING_RATE * own.kd * (1.0 - 1e-9)  # where the ratio, not the rate, bounds the spring
    assert bent.any()
    np.testing.assert_allclose(half.kp[bent], 0.25 * own.kp[bent])
    np.testing.assert_array_equal(derive_gains(model, ControllerSpec(kd=0.0), domain).kp, own.kp)


@pytest.mark.parametrize("name", ["panda", "kinova", "xarm7"])
def test_derived_springs_suit_the_inertia(name):
    """No spring alone takes its joint to full speed faster than in 0.15 s, and no damper is faster than 20/s."""
    robot = load_robot(name)
    model, gains, domain = robot.model, robot.controller.gains, robot.domain
    drawn = model.from_angles(domain.sample_q(np.random.default_rng(5), 2000))
    inertia = np.mean([np.diag(model.evaluate(q, np.zeros(model.nv)).M) for q in drawn], axis=0)
    times = inertia * np.abs(domain.v).max(axis=1) / gains.max_spring
    assert times.min() >= 0.15 * 0.9
    assert (gains.kd / inertia).max() <= 20.0 * 1.1
    assert times.min() <= 0.15 * 1.1  # a wrist's: the torque alone would allow far more


def test_rest_torque_is_the_torque_at_rest(problem, controller, states):
    for q, v in states(problem, 5):
        dyn = problem.model.evaluate(q, 0.0 * v)
        np.testing.assert_allclose(controller.u_rest(q, dyn.g), controller.evaluate(dyn).u, atol=1e-12)


def test_with_goal_moves_the_minimum(problem, controller, states):
    q, _ = next(states(problem, 1, seed=9))
    moved = controller.with_goal(q)
    assert moved.spring(q)[1] == 0.0
    np.testing.assert_allclose(moved.spring(q)[0], 0.0, atol=1e-12)
    assert controller.spring(q)[1] > 0.0
