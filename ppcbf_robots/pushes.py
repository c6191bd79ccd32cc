"""Pushes: torques from outside that neither the controller nor the filter knows of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ppcbf_robots.engines import Contact, Engine
from ppcbf_robots.specs import Array


@dataclass(frozen=True)
class Push:
    """A pulse of torque."""

    start: float  # [s]
    duration: float  # [s]
    torque: Array  # (nv,) [N m | N]


def push_torques(pushes: Sequence[Push], t: Array, nv: int) -> Array:
    """Sum of the pushes (T, nv) in the control periods that begin at t (T,) [s]."""
    total = np.zeros((len(t), nv))
    for push in pushes:
        total[(t >= push.start - 1e-9) & (t < push.start + push.duration - 1e-9)] += push.torque
    return total


class PushedEngine:
    """An engine whose robot is pushed besides; its clock starts with :meth:`reset`."""

    def __init__(self, engine: Engine, pushes: Sequence[Push]) -> None:
        self.name = engine.name
        self._engine, self._pushes, self._t = engine, pushes, 0.0

    def reset(self, q: Array, v: Array) -> None:
        """See :class:`ppcbf_robots.engines.Engine`."""
        self._engine.reset(q, v)
        self._t = 0.0

    def state(self) -> tuple[Array, Array]:
        """See :class:`ppcbf_robots.engines.Engine`."""
        return self._engine.state()

    def advance(self, u: Array, dt: float, count: int) -> None:
        """See :class:`ppcbf_robots.engines.Engine`."""
        pushed = push_torques(self._pushes, np.array([self._t]), len(u))[0]
        self._engine.advance(u + pushed, dt, count)
        self._t += count * dt

    def contacts(self) -> Sequence[Contact] | None:
        """See :class:`ppcbf_robots.engines.Engine`."""
        return self._engine.contacts()
