"""Passive nominal controllers (Definition 2 of the paper), their storage V and dissipation d_p.

All have the form ``u_des = u_rest(q) - K_d v`` with a diagonal K_d, and storage ``V = ½ vᵀ M v + P(q)`` with
``P >= 0`` and ``P(goal) = 0``; without external forces ``V̇ = -d_p`` and ``d_p = vᵀ K_d v``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.specs import Array

Kind = Literal["pd_gravity", "shaping", "bounded_spring"]


@dataclass(frozen=True)
class Nominal:
    """Output of a nominal controller at one state."""

    u: Array  # (..., nv) [N m | N]
    V: Array  # (...) storage [J]
    d_p: Array  # (...) dissipation [W]


@dataclass(frozen=True)
class Gains:
    """Gains of a nominal controller, each (nv,)."""

    kind: Kind
    kp: Array  # [N m/rad | N/m]
    kd: Array  # [N m s/rad | N s/m]
    max_spring: Array  # [N m | N], used by bounded_spring


class NominalController:
    """A passive controller towards a goal configuration.

    Kinds: ``pd_gravity`` is gravity compensation and a linear spring; ``bounded_spring`` the same with the spring
    force limited to ``max_spring``, ``f = f_max z / sqrt(1 + z²)``, ``z = K_p e / f_max``; ``shaping`` the linear
    spring without gravity compensation (the paper's cart-pole, §5.1). On continuous joints the spring is
    ``min(K_p, f_max) sin e``, which has no jump at half a turn.
    """

    def __init__(self, robot: RobotModel, gains: Gains, goal: Array) -> None:
        self.robot, self.gains, self.goal = robot, gains, goal
        self._goal_angles = robot.to_angles(goal)
        self._U0 = robot.potential_energy(goal)

    def with_goal(self, goal: Array) -> NominalController:
        """The same controller towards another configuration (nq,)."""
        return NominalController(self.robot, self.gains, goal)

    def spring(self, q: Array, goal_angles: Array | None = None) -> tuple[Array, Array]:
        """Restoring force (..., nv) and its potential (...) [J], towards the goal or ``goal_angles`` (..., nv)."""
        e = self.robot.to_angles(q) - (self._goal_angles if goal_angles is None else goal_angles)
        kp, f_max = self.gains.kp, self.gains.max_spring
        if self.gains.kind == "bounded_spring":
            root = np.sqrt(1.0 + (kp * e / f_max) ** 2)
            force, potential = kp * e / root, kp * e**2 / (1.0 + root)
            k_turn = np.minimum(kp, f_max)
        else:
            force, potential, k_turn = kp * e, 0.5 * kp * e**2, kp
        turning = self.robot.continuous
        force = np.where(turning, k_turn * np.sin(e), force)
        potential = np.where(turning, k_turn * (1.0 - np.cos(e)), potential)
        return force, potential.sum(-1)

    def u_rest(self, q: Array, g: Array, goal_angles: Array | None = None) -> Array:
        """u_des at v = 0, (..., nv), from q and the gravity torque g there."""
        force, _ = self.spring(q, goal_angles)
        return np.asarray(-force if self.gains.kind == "shaping" else g - force)

    def evaluate(self, dyn: Dynamics, goals: Array | None = None) -> Nominal:
        """Torque, storage and dissipation at one state, or at a batch with a goal (B, nq) for each."""
        force, P = self.spring(dyn.q, None if goals is None else self.robot.to_angles(goals))
        damping = self.gains.kd * dyn.v
        u = -force - damping
        if self.gains.kind == "shaping":
            at, potential = dyn.q, self.robot.potential_energy
            P = P + (potential(at) - self._U0 if goals is None else [
                potential(x) - potential(goal) for x, goal in zip(at, goals, strict=True)
            ])  # fmt: skip
        else:
            u = u + dyn.g
        return Nominal(u, np.asarray(dyn.kinetic_energy + P), np.asarray((dyn.v * damping).sum(-1)))
