"""A robot's dynamics for many states at once, read from its Pinocchio model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from ppcbf_robots.dynamics_kernel import SLIDES, TURNS, WRAPS, advance, terms_at
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.specs import Array


class BatchDynamics:
    """Terms and motion of B states of robots that differ in nothing but their links' inertias.

    Args:
        robots: one per state, without dry friction.
    """

    def __init__(self, robots: Sequence[RobotModel]) -> None:
        robot = robots[0]
        model = robot.model
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        joints = list(model.joints)[1:]
        kinds = np.full(robot.nv, TURNS)
        axes = np.empty((robot.nv, 3))
        for i, joint in enumerate(joints):
            column = pin.getJointJacobian(model, data, i + 1, pin.ReferenceFrame.LOCAL).reshape(6, -1)[:, joint.idx_v]
            slides = not np.any(column[3:])
            kinds[i] = SLIDES if slides else WRAPS if robot.continuous[i] else TURNS
            axes[i] = column[:3] if slides else column[3:]
        parents = np.array([model.parents[i + 1] - 1 for i in range(robot.nv)])
        places = np.array([model.jointPlacements[i + 1].homogeneous[:3] for i in range(robot.nv)])
        self.robot = robot
        self._tree = (parents, kinds, robot.idx_q.astype(np.int64), places, axes, model.gravity.linear.copy())
        unique = {id(r): _bodies(r.model) for r in robots}
        self._bodies = np.array([unique[id(r)] for r in robots])

    def evaluate(self, q: Array, v: Array) -> Dynamics:
        """As :meth:`ppcbf_robots.robot.RobotModel.evaluate_batch`; q (B, nq), v (B, nv)."""
        B, n = v.shape
        T, J, dJ = np.empty((B, n + 1, 4, 4)), np.empty((B, 6, n)), np.empty((B, 6, n))
        M, Minv, b, g = np.empty((B, n, n)), np.empty((B, n, n)), np.empty((B, n)), np.empty((B, n))
        terms_at(q, v, self._tree, self._bodies, T, J, dJ, M, Minv, b, g)
        return Dynamics(q.copy(), v.copy(), M, Minv, b - g, g, T, J, dJ)

    def advance(self, q: Array, v: Array, u: Array, dt: float, count: int) -> None:
        """Move the states on in place, as :meth:`ppcbf_robots.engines.PinocchioEngine.advance` does with one."""
        advance(q, v, u, dt, count, self._tree, self._bodies)


def _bodies(model: pin.Model) -> Array:
    """(n, 13) of every link: mass, centre of mass, inertia."""
    links = list(model.inertias)[1:]
    return np.array([[Y.mass, *Y.lever, *np.asarray(Y.inertia).ravel()] for Y in links])
