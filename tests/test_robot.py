"""The robot model against finite differences, Pinocchio's other algorithms and closed forms."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots.errors import InputError
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import PayloadSpec

GRAVITY = 9.81


def test_mass_bias_and_gravity_agree_with_rnea_and_aba(problem, states):
    model, rng = problem.model, np.random.default_rng(1)
    data, zero = model.model.createData(), np.zeros(model.nv)
    for q, v in states(problem, 20):
        dyn, a = model.evaluate(q, v), rng.normal(size=model.nv)
        u = pin.rnea(model.model, data, q, v, a)
        np.testing.assert_allclose(dyn.M @ a + dyn.b, u, atol=1e-9)
        np.testing.assert_allclose(dyn.g, pin.rnea(model.model, data, q, zero, zero), atol=1e-10)
        np.testing.assert_allclose(dyn.Minv @ (u - dyn.b), a, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(dyn.Minv @ dyn.M, np.eye(model.nv), atol=1e-8)
        np.testing.assert_array_equal(dyn.M, dyn.M.T)
        np.testing.assert_allclose(model.acceleration(q, v, u), a, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(model.gravity(q), dyn.g, atol=1e-10)
        assert dyn.kinetic_energy == pytest.approx(pin.computeKineticEnergy(model.model, data, q, v))


def test_coriolis_force_does_no_work_beyond_the_change_of_inertia(problem, states, along_motion):
    """vᵀ Ṁ v = 2 vᵀ C v, which ties C v to M alone."""
    model = problem.model
    for q, v in states(problem, 10):
        before, after = along_motion(model, q, v, np.zeros(model.nv))
        M_rate = (after.M - before.M) / 2e-5
        assert v @ M_rate @ v == pytest.approx(2.0 * v @ model.evaluate(q, v).Cv, rel=1e-5, abs=1e-6)


def test_gravity_is_the_gradient_of_the_potential(problem, states):
    model, step = problem.model, 1e-6
    for q, v in states(problem, 10):
        up, down = (model.potential_energy(model.integrate(q, s * v)) for s in (step, -step))
        assert (up - down) / (2 * step) == pytest.approx(model.gravity(q) @ v, rel=1e-6, abs=1e-6)


def test_points_and_jacobians_against_finite_differences(problem, states, along_motion):
    model, points, dt = problem.model, problem.safety.points, 1e-5
    rng = np.random.default_rng(2)
    for q, v in states(problem, 10):
        a = rng.normal(size=model.nv)
        dyn = model.evaluate(q, v)
        kin = points.kinematics(dyn)
        before, after = along_motion(model, q, v, a, dt)
        k0, k1 = points.kinematics(before), points.kinematics(after)
        np.testing.assert_allclose((after.J - before.J) / (2 * dt), dyn.dJ, atol=1e-6)
        np.testing.assert_allclose((k1.p - k0.p) / (2 * dt), kin.J @ v, atol=1e-6)
        velocities = [k.J @ d.v for k, d in ((k0, before), (k1, after))]
        np.testing.assert_allclose((velocities[1] - velocities[0]) / (2 * dt), kin.J @ a + kin.Jdot_v, atol=1e-6)


def test_points_lie_where_frame_placements_put_them(problem, states):
    model = problem.model
    data = model.model.createData()
    for q, v in states(problem, 5):
        pin.framesForwardKinematics(model.model, data, q)
        frames = [data.oMf[model.frame_id(s.frame)] for s in problem.robot.body]
        expected = [T.act(np.array(s.center)) for T, s in zip(frames, problem.robot.body, strict=True)]
        np.testing.assert_allclose(problem.safety.points.kinematics(model.evaluate(q, v)).p, expected, atol=1e-12)


def test_cartpole_is_the_papers(cartpole):
    model = cartpole.model
    tip = model.points(["tip"], np.zeros(3))
    for x, beta, xd, bd in np.random.default_rng(3).uniform(-2, 2, (20, 4)):
        dyn = model.evaluate(np.array([x, beta]), np.array([xd, bd]))
        np.testing.assert_allclose(dyn.M, [[2.0, np.cos(beta)], [np.cos(beta), 1.0]], atol=1e-12)
        np.testing.assert_allclose(dyn.g, [0.0, GRAVITY * np.sin(beta)], atol=1e-12)
        np.testing.assert_allclose(dyn.Cv, [-np.sin(beta) * bd**2, 0.0], atol=1e-12)
        np.testing.assert_allclose(tip.kinematics(dyn).p, [[x + np.sin(beta), 0.0, -np.cos(beta)]], atol=1e-12)


def test_two_link_is_the_papers(two_link):
    model, m, l = two_link.model, 5.0, 0.35
    inertia = m * l**2 / 12.0
    for q1, q2, v1, v2 in np.random.default_rng(4).uniform(-2, 2, (20, 4)):
        dyn = model.evaluate(np.array([q1, q2]), np.array([v1, v2]))
        coupling = inertia + m * l**2 * (0.25 + 0.5 * np.cos(q2))
        M11 = 2.0 * inertia + m * l**2 * (1.5 + np.cos(q2))
        s, c1, c12 = 0.5 * m * l**2 * np.sin(q2), np.cos(q1), np.cos(q1 + q2)
        np.testing.assert_allclose(dyn.M, [[M11, coupling], [coupling, inertia + 0.25 * m * l**2]], rtol=1e-12)
        np.testing.assert_allclose(dyn.Cv, [-s * (2 * v1 * v2 + v2**2), s * v1**2], atol=1e-12)
        g2 = 0.5 * m * GRAVITY * l * c12
        np.testing.assert_allclose(dyn.g, [1.5 * m * GRAVITY * l * c1 + g2, g2], atol=1e-12)
        p = two_link.safety.points.kinematics(dyn).p
        np.testing.assert_allclose(p, [[l * (c1 + c12), 0.0, l * (np.sin(q1) + np.sin(q1 + q2))]], atol=1e-12)


def test_continuous_joints_move_and_convert_like_pinocchios(problem):
    model, rng, step = problem.model, np.random.default_rng(5), 1e-7
    for _ in range(20):
        angles, v = rng.uniform(-3.1, 3.1, model.nv), rng.normal(size=model.nv)
        q = model.from_angles(angles)
        np.testing.assert_allclose(model.to_angles(q), angles, atol=1e-12)
        rate = (pin.integrate(model.model, q, step * v) - pin.integrate(model.model, q, -step * v)) / (2 * step)
        np.testing.assert_allclose(model.q_rate(q, v), rate, atol=1e-7)
        np.testing.assert_allclose(model.from_angles(angles + v), model.integrate(q, v), atol=1e-12)
        np.testing.assert_allclose(model.difference(q, model.integrate(q, v)), v, atol=1e-9)


def test_kinova_has_continuous_joints_without_limits(kinova):
    model = kinova.model
    assert model.continuous.sum() == 3
    assert model.nq == model.nv + 3
    assert np.all(np.isinf(model.q_lower[model.continuous]))
    batch = model.from_angles(np.full((4, model.nv), 0.3))
    np.testing.assert_allclose(model.to_angles(batch), 0.3)


def test_evaluations_are_read_only_copies(problem, states):
    q, v = next(states(problem, 1))
    dyn = problem.model.evaluate(q, v)
    copies = {name: array.copy() for name, array in vars(dyn).items()}
    for name, array in vars(dyn).items():
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
        assert array.flags.writeable is False, name
    problem.model.evaluate(problem.model.integrate(q, v), 2.0 * v)
    assert all(np.array_equal(copies[name], array) for name, array in vars(dyn).items())


def test_batch_equals_single(problem, states):
    model = problem.model
    q, v = (np.array(x) for x in zip(*states(problem, 4), strict=True))
    batch = model.evaluate_batch(q, v)
    points = problem.safety.points.kinematics(batch)
    np.testing.assert_allclose(batch.b, batch.Cv + batch.g)
    for i in range(4):
        single = model.evaluate(q[i], v[i])
        for name, array in vars(single).items():
            scale = max(1.0, np.abs(array).max())
            np.testing.assert_allclose(getattr(batch, name)[i], array, atol=1e-11 * scale, err_msg=name)
        assert batch.kinetic_energy[i] == pytest.approx(single.kinetic_energy)
        for name, array in vars(problem.safety.points.kinematics(single)).items():
            np.testing.assert_allclose(getattr(points, name)[i], array, atol=1e-9 * max(1.0, np.abs(array).max()))


def test_locked_joints_leave_the_same_robot_at_that_position(two_link):
    locked = RobotModel(two_link.model.urdf, locked={"elbow": 0.7})
    assert locked.joint_names == ["shoulder"]
    full = two_link.model.evaluate(np.array([0.4, 0.7]), np.zeros(2))
    dyn = locked.evaluate(np.array([0.4]), np.zeros(1))
    np.testing.assert_allclose(dyn.M, full.M[:1, :1])
    np.testing.assert_allclose(dyn.g, full.g[:1])
    np.testing.assert_allclose(locked.points(["tip"], np.zeros(3)).kinematics(dyn).p,
                               two_link.safety.points.kinematics(full).p)  # fmt: skip
    np.testing.assert_array_equal(locked.u_max, [50.0])


def test_locked_continuous_joint_is_held_at_its_angle(kinova):
    name = kinova.model.joint_names[0]
    locked = RobotModel(kinova.model.urdf, locked={**kinova.model.locked, name: 0.5})
    angles = np.linspace(-0.4, 0.6, kinova.model.nv)
    angles[0] = 0.5
    full, dyn = (m.gravity(m.from_angles(a)) for m, a in ((kinova.model, angles), (locked, angles[1:])))
    np.testing.assert_allclose(dyn, full[1:], atol=1e-10)


def test_locking_an_unknown_joint_or_all_is_refused(two_link):
    urdf = two_link.model.urdf
    with pytest.raises(InputError) as error:
        RobotModel(urdf, locked={"wrist": 0.0})
    assert str(error.value) == f"{urdf}: locked joint 'wrist' is not a moving joint (moving: shoulder, elbow)"
    with pytest.raises(InputError, match="no joint moves; check 'locked' and the joint types"):
        RobotModel(urdf, locked={"shoulder": 0.0, "elbow": 0.0})


def test_payload_adds_its_weight_and_its_inertia(panda, states):
    mass, com = 2.5, [0.01, -0.02, 0.05]
    plain = panda.model
    payload = PayloadSpec(frame="panda_hand", mass=mass, com=com)
    loaded = RobotModel(plain.urdf, plain.package_dirs, plain.locked, payload=payload)
    point = plain.points(["panda_hand"], np.array(com))
    for q, v in states(panda, 10):
        a, b = plain.evaluate(q, v), loaded.evaluate(q, v)
        kin = point.kinematics(a)
        J = kin.J[0]
        np.testing.assert_allclose(b.g - a.g, mass * GRAVITY * J[2], atol=1e-9)
        np.testing.assert_allclose(b.M - a.M, mass * J.T @ J, atol=1e-9)
        np.testing.assert_allclose(b.Cv - a.Cv, mass * J.T @ kin.Jdot_v[0], atol=1e-9)


def test_limits_come_from_the_urdf_and_can_be_overridden(two_link):
    urdf = two_link.model.urdf
    np.testing.assert_array_equal(RobotModel(urdf, effort=7.0).u_max, [7.0, 7.0])
    np.testing.assert_array_equal(RobotModel(urdf, effort=[3.0, 4.0]).u_max, [3.0, 4.0])
    np.testing.assert_array_equal(RobotModel(urdf, effort={"elbow": 5.0}).u_max, [50.0, 5.0])
    np.testing.assert_array_equal(RobotModel(urdf, velocity={"shoulder": 2.0}).v_max, [2.0, 1.0])


def test_an_unknown_frame_is_refused_with_the_known_links(two_link):
    model = two_link.model
    with pytest.raises(InputError) as error:
        model.frame_id("hand")
    assert str(error.value) == f"{model.urdf}: no link or frame is named 'hand' (links: base, upper, fore, tip)"
