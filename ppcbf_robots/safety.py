"""Safety functions h_k(q): signed distances of body spheres to obstacles, and joint limits, to second order.

One row k per pair of body sphere and obstacle, per pair of body spheres that could collide, and per finite joint limit;
safe is ``h_k >= 0`` for all k. A world is a family of rows, not one smooth minimum, whose curvature would be large and
false. The geometry runs compiled (:mod:`ppcbf_robots.kernels`), for one state or a batch alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.kernels import nearest_rows_at, rows_at
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.shapes import Packed, pack, smoothing_gap
from ppcbf_robots.specs import Array, BodySphere
from ppcbf_robots.world import Obstacle

ON_SURFACE = 1e-6  # [m], by which the base may be inside an obstacle that it stands on
SPEED_SIDES = ("lowest", "highest")  # order of a joint's two rows that keep it in the velocity domain


@dataclass(frozen=True)
class SafetyRows:
    """h_k with first and second order terms: ``ḣ = grad v + drift``, ``ḧ = curvature + grad a``."""

    h: Array  # (..., rows) [m], joint limits [rad | m]
    grad: Array  # (..., rows, nv)
    drift: Array  # (..., rows) = ∂h/∂t [m/s], not zero where the obstacle moves
    curvature: Array  # (..., rows): vᵀ ∇²h v, n · J̇ v, and the terms of the obstacle's motion

    def hdot(self, v: Array) -> Array:
        """ḣ (..., rows) at velocity v (..., nv)."""
        return np.asarray((self.grad @ v[..., None])[..., 0] + self.drift)


@dataclass(frozen=True)
class NearestRows:
    """What a band state needs of B states' rows: N of them, nearest first, and the least of all."""

    least_h: Array  # (B,)
    least_rho: Array  # (B,) of ``ḣ + gamma h``
    h: Array  # (B, N)
    grad: Array  # (B, N, nv)
    curvature: Array  # (B, N)


class SafetyFunction:
    """All rows h_k of a robot in a world.

    ``names`` holds the names of the ``rows`` rows, then those of the velocity ranges, joint by joint. The first
    ``obstacle_pairs`` rows are those of obstacles; with those of self-collision they are ``pairs``. ``limits`` holds
    (joint, sign, bound) of the joint limits among the rows: ``h = sign (q - bound)``.

    Args:
        robot: the robot.
        body: its body spheres.
        obstacles: solid obstacles in the base frame.
        joint_limits: whether finite joint limits are rows too (Remark 1 of the paper).
        domain: position ranges (nv, 2) that count as joint limits where they are tighter than the robot's.
        v_domain: velocity ranges (nv, 2) that a filter keeps; None keeps none.
        self_pairs: indices (S, 2) of spheres that must not touch each other; those of ``fixed`` follow the body's.
        fixed: spheres of what no joint moves.

    Raises:
        InputError: if an obstacle contains the base, or no body sphere is given.
    """

    def __init__(
        self,
        robot: RobotModel,
        body: Sequence[BodySphere],
        obstacles: Sequence[Obstacle],
        joint_limits: bool = True,
        domain: Array | None = None,
        v_domain: Array | None = None,
        self_pairs: Sequence[tuple[int, int]] = (),
        fixed: Sequence[BodySphere] = (),
    ) -> None:
        if not body:
            raise InputError("the robot has no body spheres; give `body` in the robot spec")
        self.robot, self.body, self.obstacles = robot, list(body), list(obstacles)
        self.packed = pack(obstacles)
        for i, o in enumerate(self.obstacles):
            if self.packed.distance(i, np.zeros(3)) + smoothing_gap(o) < -ON_SURFACE:
                raise InputError(f"obstacle '{o.name}' contains the robot's base (the origin); move or shrink it")
        everything = [*body, *fixed]
        self.points = robot.points([s.frame for s in body], np.array([s.center for s in body]))
        self._all_points = robot.points([s.frame for s in everything], np.array([s.center for s in everything]))
        self._radii = np.array([s.radius for s in everything])
        self._self_pairs = np.array(self_pairs, dtype=np.int64).reshape(-1, 2)
        self.limits = self._limit_rows(joint_limits, domain)
        self._limit_joint = np.array([i for i, _, _ in self.limits], dtype=np.int64)
        self._limit_sign = np.array([s for _, s, _ in self.limits])
        self._limit_bound = np.array([b for _, _, b in self.limits])
        labels = [f"{s.frame}#{i}" for i, s in enumerate(everything)]
        self.names = [f"{b} / {o.name}" for b in labels[: len(body)] for o in self.obstacles]
        self.obstacle_pairs = len(self.names)
        self.names += [f"{labels[a]} / {labels[b]}" for a, b in self._self_pairs]
        self.pairs = len(self.names)
        self.names += [f"{robot.joint_names[i]} {'lower' if sign > 0 else 'upper'} limit" for i, sign, _ in self.limits]
        self.rows = len(self.names)
        self.v_domain = np.zeros((0, 2)) if v_domain is None else v_domain
        guarded = robot.joint_names[: len(self.v_domain)]
        self.names += [f"{joint} {side} speed" for joint in guarded for side in SPEED_SIDES]

    def _limit_rows(self, wanted: bool, domain: Array | None) -> list[tuple[int, float, float]]:
        """(joint, sign, bound) of every finite bound: ``h = sign (q - bound)``."""
        if not wanted:
            return []
        lower, upper = self.robot.q_lower, self.robot.q_upper
        if domain is not None:
            turning = self.robot.continuous  # an angle that wraps has no bounds
            lower = np.where(turning, lower, np.maximum(lower, domain[:, 0]))
            upper = np.where(turning, upper, np.minimum(upper, domain[:, 1]))
        bounds = [(1.0, lower), (-1.0, upper)]
        return [(i, s, float(b[i])) for s, b in bounds for i in range(self.robot.nv) if np.isfinite(b[i])]

    def evaluate(self, dyn: Dynamics, obstacles: Packed | None = None) -> SafetyRows:
        """h and its terms of every row; leading batch axes follow ``dyn``. ``obstacles``: where they are now."""
        lead, nv = dyn.v.shape[:-1], self.robot.nv
        count = math.prod(lead)
        h, grad, drift, curvature = self._fill(
            dyn.placements.reshape(count, *dyn.placements.shape[-3:]), dyn.J.reshape(count, 6, nv),
            dyn.dJ.reshape(count, 6, nv), dyn.v.reshape(count, nv), self.robot.to_angles(dyn.q).reshape(count, nv),
            obstacles or self.packed,
        )  # fmt: skip
        shape = (*lead, self.rows)
        return SafetyRows(h.reshape(shape), grad.reshape(*shape, nv), drift.reshape(shape), curvature.reshape(shape))

    def first_order(self, q: Array) -> tuple[Array, Array]:
        """h (B, rows) and its gradient (B, rows, nv) at configurations q (B, nq), without the dynamics."""
        placements, J = self.robot.kinematics(q)
        rest = np.zeros((len(q), self.robot.nv))
        h, grad, _, _ = self._fill(placements, J, np.zeros_like(J), rest, self.robot.to_angles(q), self.packed)
        return h, grad

    def _fill(
        self, placements: Array, J: Array, dJ: Array, v: Array, angles: Array, o: Packed
    ) -> tuple[Array, Array, Array, Array]:
        """h, gradient, drift and curvature of a batch."""
        h, drift, curvature = (np.empty((len(v), self.rows)) for _ in range(3))
        grad = np.empty((len(v), self.rows, self.robot.nv))
        rows_at(placements, J, dJ, v, angles, h, grad, drift, curvature, *self._scene(o))
        return h, grad, drift, curvature

    def nearest(self, dyn: Dynamics, gamma: float, share: Array, count: int) -> NearestRows:
        """The ``count`` rows of least ``gamma h + min(ḣ, 0)`` at each of B states, among obstacles at rest.

        ``share`` (B,) is that of v at which the least rho is asked for.
        """
        size, nv = dyn.v.shape
        count = min(count, self.rows)
        least, least_rho = np.empty(size), np.empty(size)
        h, curvature, grad = np.empty((size, count)), np.empty((size, count)), np.empty((size, count, nv))
        nearest_rows_at(
            dyn.placements, dyn.J, dyn.dJ, dyn.v, self.robot.to_angles(dyn.q), gamma, share,
            least, least_rho, h, grad, curvature, *self._scene(self.packed),
        )  # fmt: skip
        return NearestRows(least, least_rho, h, grad, curvature)

    def _scene(self, o: Packed) -> tuple[Any, ...]:
        """Body, obstacles, pairs and limits as the kernels take them."""
        points = self._all_points
        return (
            points.joints, points.offsets, points.mask, self._radii, len(self.body),
            o.kinds, o.sizes, o.margins, o.planes, o.plane_start, o.frames, o.motions,
            self._self_pairs, self._limit_joint, self._limit_sign, self._limit_bound,
        )  # fmt: skip

    def least(self, q: Array) -> tuple[float, str]:
        """Smallest h at rest in q and the name of its row."""
        h = self.evaluate(self.robot.evaluate(q, np.zeros(self.robot.nv))).h
        k = int(np.argmin(h))
        return float(h[k]), self.names[k]
