"""Dynamics and motion of many plants at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ppcbf_robots.rigid_tree import bodies_of
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.specs import Array


class BatchDynamics:
    """Terms and motion of B states of robots that differ in nothing but their links' inertias.

    Args:
        robots: one per state, without dry friction.
    """

    def __init__(self, robots: Sequence[RobotModel]) -> None:
        unique = {id(r): bodies_of(r.model) for r in robots}
        self._tree, self._bodies = robots[0].tree, np.array([unique[id(r)] for r in robots])

    def evaluate(self, q: Array, v: Array) -> Dynamics:
        """As :meth:`ppcbf_robots.robot.RobotModel.evaluate_batch`; q (B, nq), v (B, nv)."""
        return Dynamics(**self._tree.terms(q, v, self._bodies))

    def advance(self, q: Array, v: Array, u: Array, dt: float, count: int) -> None:
        """Move the states on in place, as :meth:`ppcbf_robots.engines.PinocchioEngine.advance` does with one."""
        self._tree.advance(q, v, u, self._bodies, dt, count)
