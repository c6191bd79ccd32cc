"""Safety functions h_k(q): signed distances of body spheres to obstacles, and joint limits, to second order.

One row k per pair of body sphere and obstacle, and one per finite joint limit; safe is ``h_k >= 0`` for all k. A world
is a family of rows, not one smooth minimum, whose curvature would be large and false.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.specs import Array, BodySphere
from ppcbf_robots.world import HalfSpace, Sphere

_TINY = 1e-9  # [m], below which the direction away from a sphere's centre is not defined


@dataclass(frozen=True)
class SafetyRows:
    """h_k with first and second order terms: ḣ = grad v, ḧ = curvature + grad a."""

    h: Array  # (..., rows) [m], joint limits [rad | m]
    grad: Array  # (..., rows, nv)
    curvature: Array  # (..., rows) = vᵀ ∇²h v, including n · J̇ v


class SafetyFunction:
    """All rows h_k of a robot in a world.

    Args:
        robot: the robot.
        body: its body spheres.
        obstacles: solid spheres and half-spaces in the base frame.
        joint_limits: whether finite joint limits are rows too (Remark 1 of the paper).

    Raises:
        InputError: if an obstacle contains the base, or no body sphere is given.
    """

    def __init__(
        self,
        robot: RobotModel,
        body: Sequence[BodySphere],
        obstacles: Sequence[Sphere | HalfSpace],
        joint_limits: bool = True,
    ) -> None:
        if not body:
            raise InputError("the robot has no body spheres; give `body` in the robot spec")
        self.robot, self.body, self.obstacles = robot, list(body), list(obstacles)
        for o in self.obstacles:
            if obstacle_distance(o, np.zeros(3)) < 0.0:
                raise InputError(f"obstacle '{o.name}' contains the robot's base (the origin); move or shrink it")
        self.points = robot.points([s.frame for s in body], np.array([s.center for s in body]))
        radii = np.array([s.radius for s in body])
        balls = [o for o in self.obstacles if isinstance(o, Sphere)]
        planes = [o for o in self.obstacles if isinstance(o, HalfSpace)]
        self._centers = np.array([o.center for o in balls]).reshape(-1, 3)
        self._ball_gap = radii[:, None] + np.array([o.radius + o.margin for o in balls])
        self._normals = np.array([o.normal for o in planes]).reshape(-1, 3)
        self._plane_gap = radii[:, None] + np.array([o.offset + o.margin for o in planes])
        self._limits = self._limit_rows(joint_limits)
        labels = [f"{s.frame}#{i}" for i, s in enumerate(body)]
        self.names = [f"{b} / {o.name}" for kind in (balls, planes) for b in labels for o in kind]
        self.pairs = len(self.names)
        self.names += [
            f"{robot.joint_names[i]} {'lower' if sign > 0 else 'upper'} limit" for i, sign, _ in self._limits
        ]
        self.rows = len(self.names)
        self._limit_index = np.array([i for i, _, _ in self._limits], dtype=int)
        self._limit_sign = np.array([s for _, s, _ in self._limits])
        self._limit_bound = np.array([b for _, _, b in self._limits])
        self._limit_grad = np.zeros((len(self._limits), robot.nv))
        self._limit_grad[np.arange(len(self._limits)), self._limit_index] = self._limit_sign

    def _limit_rows(self, wanted: bool) -> list[tuple[int, float, float]]:
        if not wanted:
            return []
        bounds = [(1.0, self.robot.q_lower), (-1.0, self.robot.q_upper)]
        return [(i, s, float(b[i])) for s, b in bounds for i in range(self.robot.nv) if np.isfinite(b[i])]

    def evaluate(self, dyn: Dynamics) -> SafetyRows:
        """h, gradient and curvature of every row; leading batch axes follow ``dyn``."""
        point = self.points.kinematics(dyn)
        v = dyn.v[..., None, :, None]
        velocity = (point.J @ v)[..., 0]  # (..., points, 3)
        parts = []
        if len(self._centers):
            away = point.p[..., :, None, :] - self._centers  # (..., points, balls, 3)
            D = np.maximum(np.sqrt((away * away).sum(-1)), _TINY)
            n = away / D[..., None]
            grad = n @ point.J
            along = (n @ velocity[..., None])[..., 0]
            across = (velocity * velocity).sum(-1)[..., None] - along**2
            curvature = (n @ point.Jdot_v[..., None])[..., 0] + across / D  # H = (I - n nᵀ)/D
            parts.append((D - self._ball_gap, grad, curvature))
        if len(self._normals):
            h = point.p @ self._normals.T - self._plane_gap
            parts.append((h, self._normals @ point.J, point.Jdot_v @ self._normals.T))
        lead = dyn.v.shape[:-1]
        flat = [(h.reshape(*lead, -1), G.reshape(*lead, -1, G.shape[-1]), c.reshape(*lead, -1)) for h, G, c in parts]
        if len(self._limits):
            h = self._limit_sign * (self.robot.to_angles(dyn.q)[..., self._limit_index] - self._limit_bound)
            flat.append((h, np.broadcast_to(self._limit_grad, (*lead, *self._limit_grad.shape)), np.zeros_like(h)))
        h, grad, curvature = (np.concatenate(x, axis=len(lead)) for x in zip(*flat, strict=True))
        return SafetyRows(h, grad, curvature)

    def least(self, q: Array) -> tuple[float, str]:
        """Smallest h at rest in q and the name of its row."""
        h = self.evaluate(self.robot.evaluate(q, np.zeros(self.robot.nv))).h
        k = int(np.argmin(h))
        return float(h[k]), self.names[k]


def obstacle_distance(obstacle: Sphere | HalfSpace, p: Array) -> float:
    """Signed distance [m] of a point to an obstacle's surface, margin not counted."""
    if isinstance(obstacle, Sphere):
        return float(np.linalg.norm(p - np.asarray(obstacle.center)) - obstacle.radius)
    return float(np.dot(obstacle.normal, p) - obstacle.offset)
