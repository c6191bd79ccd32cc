"""Every arm of example-robot-data by name: sizes, limits, and dynamics against Pinocchio's own reading and energy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from ppcbf_robots.cli.info import u_des_outside
from ppcbf_robots.errors import InputError
from ppcbf_robots.joints import reference
from ppcbf_robots.problem import Robot, load_robot
from ppcbf_robots.resources import ALIASES, bundled, find_example
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

ARMS = {"panda": (7, 7), "panda_collision": (7, 7), "ur3": (6, 6), "ur5": (6, 6), "ur10": (6, 6), "kinova": (9, 6),
        "z1": (6, 6), "xarm7": (7, 7), "talos_left_arm": (6, 6), "so100": (5, 5), "so101": (5, 5),
        "double_pendulum": (2, 2), "asr_twodof": (2, 2), "tiago_no_hand": (7, 7), "baxter": (7, 7),
        "baxter_right": (7, 7)}  # fmt: skip
"""(nq, nv) without grippers; kinova has three continuous joints."""
MOST_OUTSIDE = 1e-3  # share of X


@pytest.fixture(scope="module", params=ARMS)
def arm(request: pytest.FixtureRequest) -> Robot:
    """Each arm by its name."""
    return load_robot(request.param)


def states(robot: Robot, count: int, seed: int = 0) -> Iterator[tuple[Array, Array]]:
    rng, domain = np.random.default_rng(seed), robot.domain
    q = robot.model.from_angles(domain.sample_q(rng, count))
    yield from zip(q, domain.sample_v(rng, count), strict=True)


def test_sizes_and_limits(arm):
    model = arm.model
    assert (model.nq, model.nv) == ARMS[arm.name]
    assert np.all(np.isfinite(model.u_max) & (model.u_max > 0.0) & np.isfinite(model.v_max) & (model.v_max > 0.0))
    assert np.all(arm.domain.q[:, 0] < arm.domain.q[:, 1])
    assert arm.body
    assert not any("gripper" in n or "finger" in n for n in model.joint_names)


def test_mass_and_bias_equal_those_of_the_whole_robot_read_from_its_file(arm):
    """Clean copy and locking against Pinocchio's own parser and RNEA on all joints, the locked ones at rest."""
    model = arm.model
    full = pin.buildModelFromUrdf(str(model.urdf))
    data = full.createData()
    rows = [full.joints[full.getJointId(n)].idx_v for n in model.joint_names]
    for q, v in states(arm, 5):
        whole, speed = reference(full, model.locked), np.zeros(full.nv)
        for j, n in zip(list(model.model.joints)[1:], model.joint_names, strict=True):
            k = full.joints[full.getJointId(n)]
            whole[k.idx_q : k.idx_q + k.nq] = q[j.idx_q : j.idx_q + j.nq]
        speed[rows] = v
        dyn = model.evaluate(q, v)
        np.testing.assert_allclose(dyn.b, pin.rnea(full, data, whole, speed, np.zeros(full.nv))[rows], atol=1e-9)
        M = np.triu(pin.crba(full, data, whole))
        M = M + np.triu(M, 1).T
        np.testing.assert_allclose(dyn.M, M[np.ix_(rows, rows)], atol=1e-10)
        np.linalg.cholesky(dyn.M)


def test_kinetic_energy_is_that_of_the_moving_masses(arm):
    """½ vᵀ M v against ½ m ċ² + ½ ωᵀ I ω summed over the links, their motion by finite differences of placements."""
    model, dt = arm.model, 1e-6
    data = [model.model.createData() for _ in range(2)]
    for q, v in states(arm, 3, seed=1):
        for d, s in zip(data, (-dt, dt), strict=True):
            pin.forwardKinematics(model.model, d, model.integrate(q, s * v))
        energy = 0.0
        for j in range(1, model.model.njoints):
            before, after = (d.oMi[j] for d in data)
            inertia = model.model.inertias[j]
            speed = (after.act(inertia.lever) - before.act(inertia.lever)) / (2 * dt)
            omega = pin.log3(before.rotation.T @ after.rotation) / (2 * dt)
            energy += 0.5 * inertia.mass * speed @ speed + 0.5 * omega @ inertia.inertia @ omega
        assert model.evaluate(q, v).kinetic_energy == pytest.approx(energy, rel=1e-6)


def test_unforced_motion_keeps_its_energy(arm):
    """Runge-Kutta steps of M⁻¹(-b); a wrong b or M would feed or drain it."""
    model = arm.model
    q, v = next(states(arm, 1, seed=2))
    v = 0.3 * v
    dt, start, scale = 2e-4, None, 0.0

    def rates(dq: Array, speed: Array) -> Array:
        dyn = model.evaluate(model.integrate(q, dq), speed)
        return -dyn.Minv @ dyn.b

    for _ in range(100):
        dyn = model.evaluate(q, v)
        energy = float(dyn.kinetic_energy) + model.potential_energy(q)
        start = energy if start is None else start
        scale = max(scale, float(dyn.kinetic_energy))
        zero = np.zeros(model.nv)
        a1 = rates(zero, v)
        a2 = rates(0.5 * dt * v, v + 0.5 * dt * a1)
        a3 = rates(0.5 * dt * (v + 0.5 * dt * a1), v + 0.5 * dt * a2)
        a4 = rates(dt * (v + 0.5 * dt * a2), v + dt * a3)
        q = model.integrate(q, dt * (v + dt / 6.0 * (a1 + a2 + a3)))
        v = v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    assert energy == pytest.approx(start, abs=1e-5 * scale)


def test_derived_gains_keep_the_torque_box(arm):
    share, _ = u_des_outside(arm, np.random.default_rng(0))
    if "controller" in arm.derived:
        assert share <= MOST_OUTSIDE


def test_one_arm_of_a_whole_robot_by_pattern(tmp_path):
    spec = tmp_path / "arm.yaml"
    spec.write_text("urdf: baxter\nmoving: [left_s*, left_e*, left_w*]\nlocked: {right_s0: 0.5}\n")
    model = load_robot(str(spec)).model
    assert model.joint_names == load_robot("baxter_left").model.joint_names
    assert model.locked["right_s0"] == 0.5
    assert model.locked["l_gripper_l_finger_joint"] == 0.0
    assert len(model.locked) == 12
    assert not model.warnings[:-1]  # of X narrowed for gravity alone


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("moving: [left_x]", "moving: no joint is named 'left_x' (joints: head_pan, left_s0, "),
        ("moving: [left_s0]\nlocked: {left_s0: 0}",
         "joint 'left_s0' is both under `moving` and under `locked`; remove it from one"),
        ("", "15 joints move, at most 8 can; write a robot spec with this `urdf` and `moving: [...]` with those of one "
         "arm, the others are then locked (they are: head_pan, left_s0, "),
        ("moving: []", "moving: list should have at least 1 item after validation, not 0, got []"),
        ("position: {left_s0: [1, -1]}", "position.left_s0: the lower limit 1.0 must be below the upper limit -1.0"),
    ],
)  # fmt: skip
def test_moving_that_does_not_fit(tmp_path, lines, expected):
    spec = tmp_path / "arm.yaml"
    spec.write_text(f"urdf: baxter\n{lines}\n")
    with pytest.raises(InputError) as error:
        load_robot(str(spec))
    assert expected in str(error.value)
    assert str(error.value).split(": ")[0] in (str(spec), str(find_example("baxter")))


def test_missing_data_are_asked_for_by_name():
    urdf = find_example("double_pendulum")
    with pytest.raises(InputError) as error:
        load_robot(str(urdf))
    assert str(error.value) == (
        f"{urdf}: joints 'joint1', 'joint2' have no usable effort and velocity limit (got 0); give them in a robot "
        "spec, e.g. `effort: {joint1: 10.0, joint2: 10.0}` and `velocity: {joint1: 2.0, joint2: 2.0}`, "
        "or lock the joint"
    )


def test_assumed_data_are_shown():
    assert "an effort of 2 N m and a speed of 5 rad/s are assumed" in load_robot("double_pendulum").model.warnings[-1]
    assert any("UR10's" in w for w in load_robot("ur3").model.warnings)


def test_grippers_are_held_and_a_lone_finger_is_not():
    urdf = find_example("z1")
    assert urdf is not None
    model = RobotModel(urdf)
    assert model.locked == {"jointGripper": 0.0}
    assert model.warnings == [
        "joint 'jointGripper' looks like a gripper's and was locked at 0; "
        "`moving` or `locked` in a robot spec decides otherwise"
    ]
    assert RobotModel(urdf, moving=["joint?", "jointGripper"]).nv == 7
    assert RobotModel(urdf, locked={"jointGripper": -0.5}).warnings == []
    finger = load_robot("finger_edu").model
    assert (finger.nv, finger.locked) == (3, {})


def test_a_link_and_a_joint_of_one_name_can_be_told_apart():
    """so100 has both a link and a joint 'gripper', which Pinocchio alone cannot lock."""
    urdf = find_example("so100")
    assert urdf is not None
    locked, free = (RobotModel(urdf, locked=x, moving=y) for x, y in (({"gripper": 0.3}, None), ({}, ["*"])))
    q = free.from_angles(np.array([0.1, 0.5, -0.5, 0.2, 0.3, 0.3]))
    frame = locked.points(["gripper"], np.zeros(3)).kinematics(locked.evaluate(q[:5], np.zeros(5)))
    other = free.points(["gripper"], np.zeros(3)).kinematics(free.evaluate(q, np.zeros(6)))
    np.testing.assert_allclose(frame.p, other.p, atol=1e-12)


def test_aliases_lead_to_bundled_specs():
    assert set(ALIASES.values()) <= set(bundled("robots"))
    assert all(find_example(name) for name in ALIASES)
