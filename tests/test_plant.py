"""Perturbed robots: their dynamics are linear in the parameters, which Pinocchio's regressor knows independently."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots.engines import PinocchioEngine
from ppcbf_robots.errors import InputError
from ppcbf_robots.plant import perturbed
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import PayloadSpec


def parameters(robot, mass, inertia, com):
    """Mass, first moment and inertia about the joint of every link, scaled, (10 nv,)."""
    out = []
    for i in range(robot.nv):
        Y = robot.model.inertias[i + 1]
        m, c, I = mass[i] * Y.mass, com[i] * Y.lever, inertia[i] * Y.inertia
        I = I + m * (c @ c * np.eye(3) - np.outer(c, c))
        out += [m, *(m * c), I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]]
    return np.array(out)


def test_dynamics_are_those_of_the_scaled_parameters(problem, states):
    robot, rng = problem.model, np.random.default_rng(0)
    mass, inertia, com = (rng.uniform(0.8, 1.2, shape) for shape in (robot.nv, robot.nv, (robot.nv, 3)))
    plant = perturbed(robot, mass, inertia, com)
    for q, v in states(problem, 10):
        a = rng.normal(size=robot.nv)
        expected = pin.computeJointTorqueRegressor(robot.model, robot.model.createData(), q, v, a)
        expected = expected @ parameters(robot, mass, inertia, com)
        dyn = plant.evaluate(q, v)
        np.testing.assert_allclose(dyn.M @ a + dyn.b, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(plant.acceleration(q, v, expected), a, rtol=1e-6, atol=1e-6)


def test_no_perturbation_changes_nothing_and_the_nominal_robot_stays(panda, states):
    robot = panda.model
    (q, v), *_ = states(panda, 1)
    before = robot.evaluate(q, v)
    same, other = perturbed(robot), perturbed(robot, 1.2, payload=PayloadSpec(frame="panda_hand", mass=2.0))
    np.testing.assert_array_equal(same.evaluate(q, v).M, before.M)
    heavier = other.evaluate(q, v)
    assert np.linalg.norm(heavier.g) > np.linalg.norm(before.g)
    np.testing.assert_array_equal(heavier.placements, before.placements)
    after = robot.evaluate(q, v)
    assert all(np.array_equal(x, getattr(after, k)) for k, x in vars(before).items())


def test_a_payload_is_the_one_of_a_robot_spec(panda, states):
    payload = PayloadSpec(frame="panda_hand", mass=1.5, com=[0.02, 0.0, 0.1])
    plant = perturbed(panda.model, payload=payload)
    spec = RobotModel(panda.model.urdf, panda.model.package_dirs, panda.robot.spec.locked, payload=payload)
    for q, v in states(panda, 3):
        np.testing.assert_allclose(plant.evaluate(q, v).M, spec.evaluate(q, v).M, atol=1e-12)
        np.testing.assert_allclose(plant.gravity(q), spec.gravity(q), atol=1e-12)


def test_dry_friction_holds_what_it_can_and_slows_the_rest(cartpole):
    """The cart with its pole hanging: below its friction it stays; sliding, it loses friction times way."""
    robot = perturbed(cartpole.model, friction=[2.0, 0.0])
    engine, down = PinocchioEngine(robot), np.array([0.0, np.pi])
    engine.reset(down, np.zeros(2))
    engine.advance(np.array([1.9, 0.0]), 5e-4, 400)
    assert engine.state()[1][0] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(engine.state()[0] - down).max() < 2e-4
    engine.advance(np.array([2.5, 0.0]), 5e-4, 400)
    assert engine.state()[1][0] > 0.02
    engine.reset(down, np.array([1.0, 0.0]))

    def energy():
        q, v = engine.state()
        return float(robot.evaluate(q, v).kinetic_energy) + robot.potential_energy(q)

    before, way = energy(), 0.0
    for _ in range(200):
        start = engine.state()[0][0]
        engine.advance(np.zeros(2), 5e-4, 1)
        way += abs(engine.state()[0][0] - start)
    assert before - energy() == pytest.approx(2.0 * way, rel=5e-3)


def test_friction_is_the_same_in_both_engines(panda):
    pytest.importorskip("mujoco")
    from ppcbf_robots.engine_mujoco import MujocoEngine

    plant = perturbed(panda.model, 1.1, 0.9, 1.05, friction=[1.0, 1.0, 1.0, 1.0, 0.3, 0.3, 0.2])
    q, v = panda.robot.start, np.array([0.5, -0.3, 0.2, 0.4, -0.6, 0.5, 1.0])
    u = plant.gravity(q)
    ends = []
    for engine in (PinocchioEngine(plant), MujocoEngine(panda, plant)):
        engine.reset(q, v)
        engine.advance(u, 5e-4, 200)
        ends.append(np.concatenate(engine.state()))
    free = PinocchioEngine(perturbed(panda.model, 1.1, 0.9, 1.05))
    free.reset(q, v)
    free.advance(u, 5e-4, 200)
    assert np.abs(np.concatenate(free.state()) - ends[0]).max() > 0.1
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-2)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"mass": -1.0}, "mass: factors must be positive"),
        ({"inertia": [1.0] * 3}, "inertia: expected one number or 7, one per moving joint, got"),
        ({"com": np.nan}, "com: every number must be finite"),
        ({"friction": -1.0}, "friction: must be at least 0"),
        ({"mass": "x"}, "mass: expected one number or 7"),
        ({"payload": PayloadSpec(frame="nosuch", mass=1.0)}, "no link or frame is named 'nosuch'"),
    ],
)
def test_perturbations_that_make_no_sense_are_refused(panda, bad, message):
    with pytest.raises(InputError) as error:
        perturbed(panda.model, **bad)
    assert message in str(error.value)
