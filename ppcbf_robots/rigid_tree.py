"""The compiled dynamics of a Pinocchio model, for many states at once."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ppcbf_robots.dynamics_kernel import SLIDES, TURNS, WRAPS, advance, terms_at
from ppcbf_robots.specs import Array


class RigidTree:
    """Joints of a model with one degree of freedom each; the links' inertias are given with the states.

    Args:
        model: read once.
    """

    def __init__(self, model: pin.Model) -> None:
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        joints = list(model.joints)[1:]
        kinds, axes = np.full(model.nv, TURNS), np.empty((model.nv, 3))
        for i, joint in enumerate(joints):
            column = pin.getJointJacobian(model, data, i + 1, pin.ReferenceFrame.LOCAL).reshape(6, -1)[:, joint.idx_v]
            slides = not np.any(column[3:])
            kinds[i] = SLIDES if slides else WRAPS if joint.nq == 2 else TURNS
            axes[i] = column[:3] if slides else column[3:]
        parents = np.array([model.parents[i + 1] - 1 for i in range(model.nv)])
        places = np.array([model.jointPlacements[i + 1].homogeneous[:3] for i in range(model.nv)])
        idx_q = np.array([joint.idx_q for joint in joints], dtype=np.int64)
        self._tree = (parents, kinds, idx_q, places, axes, model.gravity.linear.copy())

    def terms(self, q: Array, v: Array, bodies: Array) -> dict[str, Array]:
        """The fields of :class:`ppcbf_robots.robot.Dynamics` at q (B, nq), v (B, nv) with bodies (B, nv, 13)."""
        B, n = v.shape
        T, J, dJ = np.empty((B, n + 1, 4, 4)), np.empty((B, 6, n)), np.empty((B, 6, n))
        M, Minv, b, g = np.empty((B, n, n)), np.empty((B, n, n)), np.empty((B, n)), np.empty((B, n))
        q, v = np.array(q, float, order="C"), np.array(v, float, order="C")
        terms_at(q, v, self._tree, bodies, T, J, dJ, M, Minv, b, g)
        return {"q": q, "v": v, "M": M, "Minv": Minv, "Cv": b - g, "g": g, "placements": T, "J": J, "dJ": dJ}

    def advance(self, q: Array, v: Array, u: Array, bodies: Array, dt: float, count: int) -> None:
        """Move states on in place by ``count`` Runge-Kutta steps of dt [s] under the torques u (B, nv)."""
        advance(q, v, u, dt, count, self._tree, bodies)


def bodies_of(model: pin.Model) -> Array:
    """(nv, 13) of every link: mass, centre of mass, inertia."""
    links = list(model.inertias)[1:]
    return np.array([[Y.mass, *Y.lever, *np.asarray(Y.inertia).ravel()] for Y in links])
