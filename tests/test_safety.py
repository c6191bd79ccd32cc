"""Safety functions against an independent geometry engine (Coal) and finite differences."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots.errors import InputError
from ppcbf_robots.safety import SafetyFunction, obstacle_distance
from ppcbf_robots.specs import BodySphere
from ppcbf_robots.world import HalfSpace, Sphere

MIXED = [
    Sphere(type="sphere", name="ball", center=[0.4, 0.3, 0.5], radius=0.15, margin=0.02),
    HalfSpace(type="half_space", name="table", normal=[0.0, 0.0, 1.0], offset=-0.05, margin=0.01),
    Sphere(type="sphere", name="far", center=[-0.6, 0.1, 0.9], radius=0.1),
    HalfSpace(type="half_space", name="tilted", normal=[0.6, 0.0, -0.8], offset=-0.9),
]


@pytest.fixture
def mixed(problem):
    """The robot among spheres and half-spaces, some with a margin."""
    return SafetyFunction(problem.model, problem.robot.body, MIXED)


def coal_distance(model, data, sphere, obstacle) -> float:
    """Signed distance by Coal, less the margin; ``data`` holds the frame placements."""
    T = data.oMf[model.frame_id(sphere.frame)]
    body = coal.Sphere(max(sphere.radius, 1e-9)), coal.Transform3s(np.eye(3), T.act(np.array(sphere.center)))
    if isinstance(obstacle, Sphere):
        solid = coal.Sphere(obstacle.radius), coal.Transform3s(np.eye(3), np.array(obstacle.center))
    else:
        solid = coal.Halfspace(np.array(obstacle.normal), obstacle.offset), coal.Transform3s.Identity()
    return coal.distance(*body, *solid, coal.DistanceRequest(), coal.DistanceResult()) - obstacle.margin


def test_h_is_coals_distance(problem, mixed, states):
    model = problem.model
    data = model.model.createData()
    for q, v in states(problem, 20):
        pin.framesForwardKinematics(model.model, data, q)
        expected = {
            f"{s.frame}#{i} / {o.name}": coal_distance(model, data, s, o)
            for i, s in enumerate(problem.robot.body)
            for o in MIXED
        }
        h = mixed.evaluate(model.evaluate(q, v)).h[: mixed.pairs]
        assert h == pytest.approx([expected[name] for name in mixed.names[: mixed.pairs]], abs=1e-6)
        assert len(expected) == mixed.pairs


def test_gradient_and_curvature_against_finite_differences(problem, mixed, states, along_motion):
    model, rng, dt = problem.model, np.random.default_rng(1), 1e-4
    for q, v in states(problem, 20):
        a = rng.normal(size=model.nv)
        rows = mixed.evaluate(model.evaluate(q, v))
        before, after = (mixed.evaluate(dyn).h for dyn in along_motion(model, q, v, a, dt))
        np.testing.assert_allclose((after - before) / (2 * dt), rows.grad @ v, atol=1e-5)
        np.testing.assert_allclose((after - 2 * rows.h + before) / dt**2, rows.curvature + rows.grad @ a, atol=1e-4)


def test_joint_limit_rows(problem, mixed, states):
    model = problem.model
    q, v = next(states(problem, 1, seed=3))
    rows = mixed.evaluate(model.evaluate(q, v))
    angles = model.to_angles(q)
    for name, h in zip(mixed.names[mixed.pairs :], rows.h[mixed.pairs :], strict=True):
        joint, side, _ = name.split()
        i = model.joint_names.index(joint)
        assert h == pytest.approx(angles[i] - model.q_lower[i] if side == "lower" else model.q_upper[i] - angles[i])
        assert not model.continuous[i]
    assert np.all(rows.curvature[mixed.pairs :] == 0.0)


def test_rows_are_named_and_counted(problem, mixed):
    finite = np.isfinite(problem.model.q_lower).sum() + np.isfinite(problem.model.q_upper).sum()
    assert mixed.pairs == len(problem.robot.body) * len(MIXED)
    assert mixed.rows == len(mixed.names) == len(set(mixed.names)) == mixed.pairs + finite
    without = SafetyFunction(problem.model, problem.robot.body, MIXED, joint_limits=False)
    assert without.names == mixed.names[: mixed.pairs]


def test_batch_equals_single(problem, mixed, states):
    q, v = (np.array(x) for x in zip(*states(problem, 3), strict=True))
    batch = mixed.evaluate(problem.model.evaluate_batch(q, v))
    for i in range(3):
        single = mixed.evaluate(problem.model.evaluate(q[i], v[i]))
        for name, array in vars(single).items():
            np.testing.assert_allclose(getattr(batch, name)[i], array, atol=1e-12)


def test_the_papers_safety_functions(cartpole, two_link):
    h = cartpole.safety.evaluate(cartpole.model.evaluate(np.array([0.4, 1.0]), np.zeros(2))).h
    assert cartpole.safety.names[0] == "cart#0 / wall"
    assert h[0] == pytest.approx(1.5 - 0.4)
    q1, q2, l = 0.3, 0.4, 0.35
    tip = l * np.array([np.cos(q1) + np.cos(q1 + q2), np.sin(q1) + np.sin(q1 + q2)])
    least, name = two_link.safety.least(np.array([q1, q2]))
    assert name == "tip#0 / circle"
    assert least == pytest.approx(np.linalg.norm(tip - 0.6) - 0.2)


def test_at_a_spheres_centre_everything_is_finite(two_link):
    ball = Sphere(type="sphere", name="ball", center=[0.7, 0.0, 0.0], radius=0.1)
    safety = SafetyFunction(two_link.model, two_link.robot.body, [ball])
    rows = safety.evaluate(two_link.model.evaluate(np.zeros(2), np.array([1.0, -1.0])))
    assert rows.h[0] == pytest.approx(-0.1)
    assert all(np.all(np.isfinite(x)) for x in vars(rows).values())


def test_no_body_and_an_obstacle_over_the_base_are_refused(two_link):
    with pytest.raises(InputError) as error:
        SafetyFunction(two_link.model, [], MIXED)
    assert str(error.value) == "the robot has no body spheres; give `body` in the robot spec"
    over = Sphere(type="sphere", name="over", center=[0.0, 0.0, 0.05], radius=0.1)
    with pytest.raises(InputError) as error:
        SafetyFunction(two_link.model, [BodySphere(frame="tip")], [over])
    assert str(error.value) == "obstacle 'over' contains the robot's base (the origin); move or shrink it"


def test_obstacle_distance_leaves_the_margin_out():
    ball, table = MIXED[0], MIXED[1]
    assert obstacle_distance(ball, np.array([0.4, 0.3, 0.9])) == pytest.approx(0.25)
    assert obstacle_distance(table, np.array([1.0, 2.0, 0.2])) == pytest.approx(0.25)
