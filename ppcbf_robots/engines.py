"""What moves the robot in a rollout: an engine takes a state and a torque some way ahead in time.

Pinocchio's articulated-body algorithm with RK4 is the default and knows no contact. Another engine (see
:mod:`ppcbf_robots.engine_mujoco`) implements the same protocol; the control loop and its record stay one piece of code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

EngineName = Literal["pinocchio", "mujoco"]
RUB_SWEEPS = 20


@dataclass(frozen=True)
class Contact:
    """A link that touches an obstacle at one instant."""

    link: str
    obstacle: str
    depth: float  # [m], penetration
    hull_only: bool = False  # the convex hull of the link's mesh touches, the mesh does not


class Engine(Protocol):
    """A robot in motion."""

    name: EngineName

    def reset(self, q: Array, v: Array) -> None:
        """Put the robot into the state (q, v); q (nq,) in Pinocchio's coordinates, v (nv,)."""

    def state(self) -> tuple[Array, Array]:
        """(q, v) now, as in :meth:`reset`."""

    def advance(self, u: Array, dt: float, count: int) -> None:
        """``count`` integration steps of ``dt`` [s] under the torque u (nv,), held."""

    def contacts(self) -> Sequence[Contact] | None:
        """What touches in the present state; None if the engine knows no contact."""


class PinocchioEngine:
    """Free motion by Pinocchio's forward dynamics and RK4, then the joints' dry friction; no obstacle pushes back."""

    name: EngineName = "pinocchio"

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot
        self._dry = bool(np.any(robot.friction > 0.0))
        self._q, self._v = np.zeros(robot.nq), np.zeros(robot.nv)

    def reset(self, q: Array, v: Array) -> None:
        """See :class:`Engine`."""
        self._q, self._v = q, v

    def state(self) -> tuple[Array, Array]:
        """See :class:`Engine`."""
        return self._q, self._v

    def advance(self, u: Array, dt: float, count: int) -> None:
        """See :class:`Engine`."""
        for _ in range(count):
            self._q, self._v = _rk4(self.robot, self._q, self._v, u, dt)
            if self._dry:
                self._v = _rub(self.robot, self._q, self._v, dt)

    def contacts(self) -> None:
        """None: there is no contact here."""
        return None


class ContactLog:
    """Collects the contacts of a rollout."""

    def __init__(self) -> None:
        self._known = False
        self._steps = self._hull_steps = 0
        self._pairs: dict[tuple[str, str], dict[str, Any]] = {}  # in the order of first contact

    def add(self, t: float, contacts: Sequence[Contact] | None) -> None:
        """Contacts of the state at the control step of time t [s]."""
        self._known = contacts is not None
        real = any(not c.hull_only for c in contacts or ())
        self._steps += real
        self._hull_steps += bool(contacts) and not real
        for c in contacts or ():
            new = {"link": c.link, "obstacle": c.obstacle, "first": t, "depth": c.depth, "hull_only": True}
            pair = self._pairs.setdefault((c.link, c.obstacle), new)
            pair["depth"] = max(pair["depth"], c.depth)
            pair["hull_only"] = pair["hull_only"] and c.hull_only

    def report(self) -> dict[str, Any] | None:
        """Control steps in contact, those where only hulls touch, and the pairs; None if unknown.

        A pair has first time [s], largest penetration [m] and whether only the link's hull ever touched.
        """
        pairs = list(self._pairs.values())
        return {"steps": self._steps, "hull_steps": self._hull_steps, "pairs": pairs} if self._known else None


def _rk4(model: RobotModel, q: Array, v: Array, u: Array, dt: float) -> tuple[Array, Array]:
    """One Runge-Kutta step on the configuration manifold, torque held."""
    a1 = model.acceleration(q, v, u)
    v2 = v + 0.5 * dt * a1
    a2 = model.acceleration(model.integrate(q, 0.5 * dt * v), v2, u)
    v3 = v + 0.5 * dt * a2
    a3 = model.acceleration(model.integrate(q, 0.5 * dt * v2), v3, u)
    v4 = v + dt * a3
    a4 = model.acceleration(model.integrate(q, dt * v3), v4, u)
    mean_v = (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
    return model.integrate(q, dt * mean_v), v + dt * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0


def _rub(model: RobotModel, q: Array, v: Array, dt: float) -> Array:
    """Velocity after Coulomb friction over dt, by time stepping (Moreau): the impulse p with ``|p_i| <= friction_i dt``
    that leaves the least kinetic energy, by projected Gauss-Seidel, which never adds any.

    A joint sticks where its friction can hold it.
    """
    Minv = model.evaluate(q, v).Minv
    bound, p, v = model.friction * dt, np.zeros(model.nv), v.copy()
    for _ in range(RUB_SWEEPS):
        for i in range(model.nv):
            wanted = min(max(p[i] + v[i] / Minv[i, i], -bound[i]), bound[i])
            v -= Minv[:, i] * (wanted - p[i])
            p[i] = wanted
    return v
