"""The barrier's rows with K_theta as it is at the end of a control period.

``psi(u)`` takes K to be linear in v. It is convex: at the velocity ``v⁺ = v + dt v̇`` that the period ends with it is
larger, by much where a light joint comes to a stop and turns within one period. The velocities ``v⁺`` that keep a row
form a convex set, so the tangent of K at one outside it is a plane that cuts off that one and none inside.
"""

from __future__ import annotations

import numpy as np

from ppcbf_robots.barriers import BarrierRows, K_at
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.robot import Dynamics
from ppcbf_robots.safety import SafetyRows
from ppcbf_robots.specs import Array


def shortfall_and_cut(
    network: NumpyNetwork, dyn: Dynamics, safety: SafetyRows, rows: BarrierRows, u: Array, dt: float
) -> tuple[float, BarrierRows]:
    """How much less than ``psi(u)`` phi changes over one period [m/s²], and the rows with K's tangent at its end.

    Args:
        network: a convex K_theta.
        dyn: the state.
        safety: its h and gradients.
        rows: those of the barrier at that state, L_f phi perhaps lowered.
        u: torque (nv,), gravity included, held over the period.
        dt: control period [s].

    Returns:
        ``(K(q, v⁺) - K(q, v)) / dt - ∂K/∂v · v̇``, at least 0, and as many rows as there were. Their psi differs from
        that of ``rows`` by K's change over the period, divided by dt, instead of ``∂K/∂v · v̇``.
    """
    acceleration = dyn.Minv @ (u - dyn.b)
    (K, slope), (K_end, slope_end) = (K_at(network, dyn, v) for v in (dyn.v, dyn.v + dt * acceleration))
    rise = (K_end - K) / dt
    w = rows.w - (slope_end - slope)
    Lg = w @ dyn.Minv
    Lf = rows.Lf_phi + (rows.Lg_phi - Lg) @ dyn.b - (rise - slope_end @ acceleration)
    return float(rise - slope @ acceleration), BarrierRows(rows.h, rows.hdot, rows.phi, Lf, Lg, w)


def together(first: BarrierRows, second: BarrierRows) -> BarrierRows:
    """All rows of both."""
    return BarrierRows(
        *(np.concatenate(pair) for pair in zip(vars(first).values(), vars(second).values(), strict=True))
    )
