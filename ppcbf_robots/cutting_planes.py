"""The barrier's rows with K_theta as it is at the end of a control period.

``psi(u)`` takes K to be linear in v. It is convex: at the velocity ``v⁺ = v + dt v̇`` that the period ends with it is
larger, by much where a light joint comes to a stop and turns within one period. The velocities ``v⁺`` that keep a row
form a convex set, so the tangent of K at one outside it is a plane that cuts off that one and none inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ppcbf_robots.barriers import BarrierRows, K_at
from ppcbf_robots.kernels import kernel
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.robot import Dynamics
from ppcbf_robots.safety import SafetyRows
from ppcbf_robots.specs import Array


class EndOfPeriod:
    """K_theta at the velocity that one period under a torque ends with, from a configuration taken as fixed.

    Args:
        network: a convex K_theta.
        dyn: the state.
        safety: its h and gradients.
        rows: those of the barrier at that state, L_f phi perhaps lowered.
        gamma: the barrier's [1/s].
        u: torque (nv,), gravity included, held over the period.
        dt: control period [s].

    ``short`` is ``(K(q, v⁺) - K(q, v)) / dt - ∂K/∂v · v̇`` [m/s²], at least 0: how much less than ``psi(u)`` phi changes
    over the period, per second.
    """

    def __init__(
        self, network: NumpyNetwork, dyn: Dynamics, safety: SafetyRows, rows: BarrierRows, gamma: float, u: Array,
        dt: float,
    ) -> None:  # fmt: skip
        acceleration = dyn.Minv @ (u - dyn.b)
        K, slope = rows.hdot[0] + gamma * rows.h[0] - rows.phi[0], safety.grad[0] - rows.w[0]
        K_end, slope_end = K_at(network, dyn, dyn.v + dt * acceleration)
        rise = float(K_end - K) / dt
        self.short = rise - float(slope @ acceleration)
        self._dyn, self._rows, self._turn = dyn, rows, slope_end - slope
        self._offset = rise - float(slope_end @ acceleration)

    def tangent(self) -> BarrierRows:
        """As many rows as there were, with the tangent of K at v⁺ in place of that at v."""
        rows, dyn = self._rows, self._dyn
        Lf, Lg, w = turned(rows.Lf_phi, rows.Lg_phi, rows.w, self._turn, dyn.Minv, dyn.b, self._offset)
        return BarrierRows(rows.h, rows.hdot, rows.phi, Lf, Lg, w)


@kernel
def turned(Lf: Any, Lg: Any, w: Any, turn: Any, Minv: Any, b: Any, offset: float) -> tuple[Any, Any, Any]:
    """L_f phi (R,), L_g phi and w (R, nv) with ``w - turn`` in place of w, and L_f phi less ``offset``."""
    R, nv = w.shape
    change = np.zeros(nv)  # of every row of L_g phi
    for i in range(nv):
        for j in range(nv):
            change[j] += turn[i] * Minv[i, j]
    drift = offset
    for j in range(nv):
        drift -= change[j] * b[j]
    Lf_new, Lg_new, w_new = np.empty(R), np.empty((R, nv)), np.empty((R, nv))
    for k in range(R):
        Lf_new[k] = Lf[k] - drift
        for j in range(nv):
            Lg_new[k, j] = Lg[k, j] - change[j]
            w_new[k, j] = w[k, j] - turn[j]
    return Lf_new, Lg_new, w_new


def together(first: BarrierRows, second: BarrierRows) -> BarrierRows:
    """All rows of both."""
    return BarrierRows(
        *(np.concatenate(pair) for pair in zip(vars(first).values(), vars(second).values(), strict=True))
    )
