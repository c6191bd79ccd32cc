"""X leaves out postures that the motors cannot hold, and no more than that takes."""

from __future__ import annotations

import numpy as np
import pytest

from ppcbf_robots.holdable import HELD, LEAST_VOLUME, holdable
from ppcbf_robots.problem import load_robot
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

LINK = """<link name="{name}"><inertial><origin xyz="1 0 0"/><mass value="{mass}"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>
  <origin xyz="{at}"/><limit lower="-1.5" upper="1.5" effort="{effort}" velocity="2"/></joint>"""
WEIGHT = 9.81  # [N m], of 1 kg at 1 m
NONE = np.zeros((0, 1))  # configurations that are given


def load(robot: RobotModel, box: Array, count: int = 50_000) -> Array:
    """Largest share of an effort limit that gravity takes, (count,), in other postures than those looked at."""
    angles = np.random.default_rng(7).uniform(box[:, 0], box[:, 1], (count, robot.nv))
    return np.max([np.abs(robot.gravity(q)) / robot.u_max for q in robot.from_angles(angles)], axis=1)


def pendulum(folder, effort: float, kind: str = "revolute", arm: bool = False) -> RobotModel:
    """A mass of 1 kg at 1 m, whose gravity torque is ``9.81 cos q``; or two of them in line."""
    links = ["<link name='base'/>", LINK.format(name="a", mass=1)]
    joints = [JOINT.format(name="ja", kind=kind, parent="base", child="a", at="0 0 0", effort=effort)]
    if arm:
        links.append(LINK.format(name="b", mass=1))
        joints.append(JOINT.format(name="jb", kind=kind, parent="a", child="b", at="1 0 0", effort=100))
    path = folder / "arm.urdf"
    path.write_text(f"<robot name='r'>{''.join(links + joints)}</robot>")
    return RobotModel(path)


def test_what_can_be_held_is_left_alone(tmp_path):
    box = np.array([[-1.5, 1.5]])
    np.testing.assert_array_equal(holdable(pendulum(tmp_path, 1.001 * WEIGHT), box, NONE), box)


def test_a_pendulum_that_cannot_be_held_level(tmp_path):
    """Held where ``|cos q| <= 0.9 · 0.5``: one side of level is left, as far as the samples lie apart."""
    (box,) = holdable(pendulum(tmp_path, 0.5 * WEIGHT), np.array([[-1.5, 1.5]]), NONE)
    edge = np.arccos(HELD * 0.5)
    side = sorted(np.abs(box))
    assert np.sign(box[0]) == np.sign(box[1])
    assert side == pytest.approx([edge, 1.5], abs=2e-3)
    assert side[0] >= edge - 1e-3


def test_joints_that_turn_freely_are_not_cut(tmp_path):
    robot, box = pendulum(tmp_path, 0.5 * WEIGHT, "continuous"), np.array([[-np.pi, np.pi]])
    np.testing.assert_array_equal(holdable(robot, box, NONE), box)


@pytest.mark.parametrize("given", [1.3, -1.3])
def test_given_configurations_stay_inside(tmp_path, given):
    robot, whole = pendulum(tmp_path, 0.5 * WEIGHT), np.array([[-1.5, 1.5]])
    box = holdable(robot, whole, np.array([[given]]))
    assert box[0, 0] <= given <= box[0, 1] and load(robot, box).max() <= 1.0
    np.testing.assert_array_equal(holdable(robot, whole, np.array([[1.3], [-1.3]])), whole)  # on both sides of level


def test_too_little_left_is_no_domain(tmp_path):
    """Of the first joint's range 2 % can be held with the second one anywhere, too little to work in."""
    robot, box = pendulum(tmp_path, 0.2 * WEIGHT, arm=True), np.array([[-1.5, 1.5], [-1.5, 1.5]])
    np.testing.assert_array_equal(holdable(robot, box, np.zeros((0, 2))), box)


@pytest.mark.parametrize("name", ["talos_left_arm", "baxter_left"])
def test_real_arms_keep_most_of_what_can_be_held(name):
    robot = load_robot(name)
    whole = np.stack([robot.model.q_lower, robot.model.q_upper], 1)
    assert load(robot.model, whole).max() > 1.1
    assert load(robot.model, robot.domain.q).max() <= 1.0
    volume = np.prod(np.ptp(robot.domain.q, axis=1) / np.ptp(whole, axis=1))
    assert volume > 3 * LEAST_VOLUME
    cut = [robot.model.joint_names[i] for i in np.flatnonzero(np.any(robot.domain.q != whole, axis=1))]
    for joint in cut:
        assert any(f"X has joint '{joint}' between" in w for w in robot.model.warnings)
    assert not any("gravity alone takes up to" in w for w in robot.model.warnings)


def test_a_given_domain_is_taken_as_it_is(tmp_path):
    spec = tmp_path / "arm.yaml"
    ranges = [[-1.7, 1.7], [-2.1, 1.0], [-3.0, 3.0], [0.0, 2.6], [-3.0, 3.0], [-1.5, 2.0], [-3.0, 3.0]]
    spec.write_text(f"urdf: baxter\nmoving: ['left_*']\ndomain: {{q: {ranges}}}\n")
    robot = load_robot(str(spec))
    np.testing.assert_array_equal(robot.domain.q, ranges)
    assert any("gravity alone takes up to" in w and "'left_s1'" in w for w in robot.model.warnings)
