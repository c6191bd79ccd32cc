"""Forward dynamics and safety rows as CasADi expressions, built from the Pinocchio model of a robot.

The articulated-body algorithm (Featherstone, *Rigid Body Dynamics Algorithms*, table 7.1) over joints of one degree of
freedom. Motions are (linear, angular) as in Pinocchio; a joint's configuration is its angle or position, also where
Pinocchio stores (cos, sin). Needs casadi, of the extras
``study`` and ``verify``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.safety import SafetyFunction
from ppcbf_robots.specs import Array
from ppcbf_robots.world import HalfSpace, Obstacle, Sphere


@dataclass(frozen=True)
class _Joint:
    """A moving joint: its axis in its own frame and how it is placed on the one before."""

    parent: int
    rotation: Array  # (3, 3), at position 0
    origin: Array  # (3,) [m]
    S: Array  # (6,) motion per unit of velocity: along or about the axis
    inertia: Array  # (6, 6)

    def placement(self, angle: Any) -> tuple[Any, Any]:
        """Rotation (3, 3) and origin (3,) of the joint's frame in its parent's."""
        along, about = self.S[:3], self.S[3:]
        if not about.any():
            return self.rotation, self.origin + self.rotation @ along * angle
        cross = pin.skew(about)
        turn = ca.DM.eye(3) + ca.sin(angle) * ca.DM(cross) + (1.0 - ca.cos(angle)) * ca.DM(cross @ cross)
        return self.rotation @ turn, self.origin


def _joints(robot: RobotModel) -> list[_Joint]:
    model = robot.model
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    joints = []
    for i in range(1, model.njoints):
        J = pin.getJointJacobian(model, data, i, pin.ReferenceFrame.LOCAL).reshape(6, -1)  # a single joint's comes flat
        S = J[:, model.joints[i].idx_v]
        T = model.jointPlacements[i]
        joints.append(_Joint(int(model.parents[i]), T.rotation.copy(), T.translation.copy(), S,
                             model.inertias[i].matrix()))  # fmt: skip
    return joints


def forward_dynamics(robot: RobotModel) -> ca.Function:
    """``a = f(angles, v, u)``, all (nv,): M⁻¹ (u - C v - g)."""
    angles, v, u = (ca.SX.sym(name, robot.nv) for name in "qvu")
    return ca.Function("a", [angles, v, u], [acceleration(robot, angles, v, u)])


def acceleration(robot: RobotModel, angles: Any, v: Any, u: Any, densities: Any = None) -> Any:
    """M⁻¹ (u - C v - g), (nv,); ``densities`` (nv,) are factors of each link's mass and inertia, by default 1."""
    joints, nv = _joints(robot), robot.nv
    X, c, I_A, p_A, velocity = [], [], [], [], [ca.SX.zeros(6)]
    for i, joint in enumerate(joints):
        X.append(_to_child(*joint.placement(angles[i])))
        velocity.append(X[i] @ velocity[joint.parent] + joint.S * v[i])
        cross = _cross(velocity[-1])
        c.append(cross @ (joint.S * v[i]))
        inertia = ca.SX(ca.DM(joint.inertia)) * (1.0 if densities is None else densities[i])
        I_A.append(inertia)
        p_A.append(-cross.T @ inertia @ velocity[-1])
    U, D, rest = ([ca.SX()] * nv for _ in range(3))
    for i in reversed(range(nv)):
        S, parent = joints[i].S, joints[i].parent - 1
        U[i] = I_A[i] @ S
        D[i], rest[i] = ca.dot(ca.DM(S), U[i]), u[i] - ca.dot(ca.DM(S), p_A[i])
        if parent >= 0:
            I_a = I_A[i] - U[i] @ U[i].T / D[i]
            I_A[parent] += X[i].T @ I_a @ X[i]
            p_A[parent] += X[i].T @ (p_A[i] + I_a @ c[i] + U[i] * rest[i] / D[i])
    pulled, a = [ca.SX(ca.DM(-robot.model.gravity.vector))], ca.SX.zeros(nv)
    for i, joint in enumerate(joints):
        pushed = X[i] @ pulled[joint.parent] + c[i]
        a[i] = (rest[i] - ca.dot(U[i], pushed)) / D[i]
        pulled.append(pushed + joint.S * a[i])
    return a


def _to_child(R: Any, origin: Any) -> Any:
    """(6, 6): motions in the parent's frame, expressed in the child's."""
    R = ca.SX(R)
    return ca.vertcat(ca.horzcat(R.T, -R.T @ ca.skew(origin)), ca.horzcat(ca.SX.zeros(3, 3), R.T))


def _cross(motion: Any) -> Any:
    """(6, 6): the cross product of a motion with motions."""
    along, about = ca.skew(motion[:3]), ca.skew(motion[3:])
    return ca.vertcat(ca.horzcat(about, along), ca.horzcat(ca.SX.zeros(3, 3), about))


def safety_rows(safety: SafetyFunction) -> ca.Function:
    """``h = f(angles)``: distances of body spheres to obstacles [m], then joint limits: the safety function's rows.

    Raises:
        InputError: if an obstacle is neither a sphere nor a half-space, or body spheres are watched against each other.
    """
    robot = safety.robot
    if safety.pairs > safety.obstacle_pairs:
        raise InputError("self-collision is not written as symbols: leave `self_collision` out of the robot spec here")
    angles = ca.SX.sym("q", robot.nv)
    frames = _frames(robot, angles)
    h = []
    for body, at, offset in zip(safety.body, safety.points.joints, safety.points.offsets, strict=True):
        R, p = frames[at]
        point = p + R @ offset[:3]
        h += [_distance(o, point) - body.radius - o.margin for o in safety.obstacles]
    h += [sign * (angles[i] - bound) for i, sign, bound in safety.limits]
    return ca.Function("h", [angles], [ca.vertcat(*h)])


def potential_energy(robot: RobotModel) -> ca.Function:
    """``P = f(angles)`` [J], as :meth:`RobotModel.potential_energy`."""
    angles = ca.SX.sym("q", robot.nv)
    frames, gravity = _frames(robot, angles), robot.model.gravity.linear
    total = ca.SX(0.0)
    for i in range(1, robot.model.njoints):
        (R, p), link = frames[i], robot.model.inertias[i]
        total -= link.mass * ca.dot(ca.DM(gravity), p + R @ link.lever)
    return ca.Function("P", [angles], [total])


def _frames(robot: RobotModel, angles: Any) -> list[tuple[Any, Any]]:
    """Rotation (3, 3) and origin (3,) of every joint's frame in the base frame, the universe's first."""
    frames: list[tuple[Any, Any]] = [(ca.SX.eye(3), ca.SX.zeros(3))]
    for i, joint in enumerate(_joints(robot)):
        (R, p), (R_joint, p_joint) = frames[joint.parent], joint.placement(angles[i])
        frames.append((R @ R_joint, p + R @ p_joint))
    return frames


def _distance(obstacle: Obstacle, point: Any) -> Any:
    """Distance [m] of a point (3,) in the base frame to an obstacle, margin not counted."""
    match obstacle:
        case Sphere():
            return ca.norm_2(point - ca.DM(obstacle.center)) - obstacle.radius
        case HalfSpace():
            return ca.dot(ca.DM(obstacle.normal), point) - obstacle.offset
    raise InputError(f"the predictive controller knows spheres and half-spaces, '{obstacle.name}' is neither")
