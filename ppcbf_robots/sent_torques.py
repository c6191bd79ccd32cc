"""The torques that the filter returned last: what may follow them at a limited rate, and where they have led."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from ppcbf_robots.errors import InputError
from ppcbf_robots.filters import Box
from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array


class SentTorques:
    """The last few torques of a loop, in the caller's convention.

    Args:
        robot: the robot they were sent to.
        dt: control period [s].
        reach: how far back :meth:`predict` may be asked for [s].
        gravity_included: False if gravity is left out of them and added by the robot itself.
        rate: how fast they may change, one number or (nv,) [N m/s | N/s]; None for the robot's own limit.
    """

    def __init__(
        self, robot: RobotModel, dt: float, reach: float, gravity_included: bool, rate: ArrayLike | None
    ) -> None:
        self.robot, self.dt, self.gravity_included = robot, dt, gravity_included
        self.rate = _rates(robot, rate)  # (nv,)
        self.rate_limited = bool(np.isfinite(self.rate).any())
        self._step = self.rate * dt
        self._sent: deque[Array] = deque(maxlen=math.ceil(reach / dt) + 1)

    def clear(self) -> None:
        """Forget all of them."""
        self._sent.clear()

    def append(self, u: Array) -> None:
        """The torque that is sent now."""
        self._sent.append(u.copy())  # the caller may write into what it was given

    def correct(self, u_last: Array) -> None:
        """The caller knows better what was in force until now."""
        if self._sent:
            self._sent.pop()
        self._sent.append(u_last.copy())

    def allowed(self, g: Array) -> Box | None:
        """Torques, gravity ``g`` included, that box and rate allow after the last one; None if rates are not limited.

        The box comes first where a last torque outside it leaves no other. Before the first one, gravity's counts.
        """
        if not self.rate_limited:
            return None
        u_max, step = self.robot.u_max, self._step
        offset = 0.0 if self.gravity_included else g
        last = self._sent[-1] + offset if self._sent else np.clip(g, -u_max, u_max)
        return np.clip(last - step, -u_max, u_max), np.clip(last + step, -u_max, u_max)

    def predict(self, q: Array, v: Array, age: float) -> tuple[Array, Array]:
        """The state ``age`` [s] after (q, v) under the torques sent since, before the first of them gravity's.

        Where that is not finite, (q, v) itself.
        """
        periods, rest = divmod(age, self.dt)
        pieces = [self.dt] * int(periods) + [rest]
        q_now, v_now = q, v
        for i, piece in enumerate(reversed(pieces)):
            behind = len(pieces) - i  # periods ago
            u = self._sent[-behind] if behind <= len(self._sent) else None
            if u is None or not self.gravity_included:
                u = self.robot.gravity(q_now) + (0.0 if u is None else u)
            v_now = v_now + piece * self.robot.acceleration(q_now, v_now, u)
            q_now = self.robot.integrate(q_now, piece * v_now)
        usable = bool(np.isfinite(q_now).all() and np.isfinite(v_now).all())
        return (q_now, v_now) if usable else (q, v)


def _rates(robot: RobotModel, rate: ArrayLike | None) -> Array:
    try:
        rates = np.array(np.broadcast_to(robot.u_rate if rate is None else rate, (robot.nv,)), float)
    except (TypeError, ValueError):
        rates = np.zeros(robot.nv)
    if not np.all(rates > 0.0):
        raise InputError(f"rate: expected one positive number or {robot.nv}, got {rate!r}")
    return rates
