"""The barrier's rows with K_theta as it is at the end of a control period.

``psi(u)`` takes K to be linear in v. It is convex: at the velocity ``v⁺ = v + dt v̇`` that the period ends with it is
larger, by much where a light joint comes to a stop and turns within one period. The velocities ``v⁺`` that keep a row
form a convex set, so the tangent of K at one outside it is a plane that cuts off that one and none inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.condense import class_k, tolerated
from ppcbf_robots.kernels import kernel
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.network_kernel import convex_units, rise
from ppcbf_robots.robot import Dynamics
from ppcbf_robots.specs import Array


@dataclass(frozen=True)
class Tangent:
    """The plane that touches K at the velocity one period ends with, against that at its beginning."""

    short: float  # [m/s²] by which phi changes less over the period than psi(u) says, at least 0 up to rounding
    turn: Array  # (nv,) what ∂K/∂v changes by
    drift: float  # by which L_f phi falls
    steering: Array  # (nv,) by which every row of L_g phi falls

    def of(self, rows: BarrierRows, which: NDArray[np.int_]) -> BarrierRows:
        """The rows numbered ``which`` with this plane in place of K's tangent at the beginning."""
        return BarrierRows(
            rows.h[which], rows.hdot[which], rows.phi[which], rows.Lf_phi[which] - self.drift,
            rows.Lg_phi[which] - self.steering, rows.w[which] - self.turn,
        )  # fmt: skip


class EndOfPeriod:
    """K_theta at the velocity that one period under a torque ends with, from a configuration taken as fixed.

    Args:
        network: a convex K_theta.
        dyn: the state.
        dt: control period [s].
    """

    def __init__(self, network: NumpyNetwork, dyn: Dynamics, dt: float) -> None:
        self._dyn, self._dt, self._energy, self._K = dyn, dt, network.energy, network.of_velocity(dyn.q)

    def tangent(self, u: Array) -> Tangent:
        """For a torque u (nv,), gravity included, held over the period."""
        dyn = self._dyn
        return Tangent(*rise(dyn.v, u, dyn.M, dyn.Minv, dyn.b, self._dt, self._energy, *self._K))


@kernel
def hold_to_the_end(
    q: Any, v: Any, u: Any, M: Any, Minv: Any, b: Any, dt: float, energy: float, layers: Any, form: Any,
    hdot: Any, phi: Any, Lf: Any, Lg: Any, alpha: float, release: float, margin: float, share: float,
    hold: Any, short: Any,
) -> None:  # fmt: skip
    """Clear ``hold`` (B,) where torques u (B, nv) let a row fall short over the period; fill in ``short`` (B,) there.

    See ``condense.falling_short``.
    """
    for s in range(len(hold)):
        if hold[s]:
            a, c, units_b = convex_units(q[s], *layers)
            short[s] = rise(v[s], u[s], M[s], Minv[s], b[s], dt, energy, a, c, units_b, *form)[0]
            for k in range(phi.shape[1]):
                slack = Lf[s, k] + class_k(hdot[s, k], phi[s, k], alpha, release, margin)
                for j in range(len(u[s])):
                    slack += Lg[s, k, j] * u[s, j]
                if slack + tolerated(phi[s, k], alpha, margin, share) < short[s]:
                    hold[s] = False
