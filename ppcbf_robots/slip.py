"""How much faster phi falls than the model says: measured from step to step, and allowed for in the next one.

Under a held torque the rows of the barrier are kept at the control instants alone; in between phi slips by its
curvature, and more where masses, friction or delays are not those of the model. What one step predicted for the next,
``phi + dt psi`` less what the rise of K_theta is known to take, is compared with what came: a bound for this state and
this plant, not one over all of X.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.kernels import kernel
from ppcbf_robots.specs import Array

LONGEST_GAP = 5.5  # control periods between two steps, over which a prediction still says something


class SlipObserver:
    """The slip of every row, ``(phi predicted - phi found) / elapsed`` [phi/s], averaged over ``time`` [s].

    Args:
        dt: control period [s].
        time: of the first-order average [s]; shorter follows faster and lets more noise through.
    """

    def __init__(self, dt: float, time: float) -> None:
        self.dt, self.time = dt, time
        self._slip = np.zeros(0)
        self._before: tuple[float, BarrierRows, Array] | None = None  # time, rows and torque of the last step

    def reset(self) -> None:
        """Nothing is known of the next step; what was learned of the slip is forgotten too."""
        self._slip, self._before = np.zeros(0), None

    def forget_step(self) -> None:
        """The next step cannot be compared with the last one, as when obstacles are elsewhere."""
        self._before = None

    def wary(self, t: float, rows: BarrierRows) -> BarrierRows:
        """The rows at time t with ``L_f phi`` lower by the slip, where there is one."""
        if len(self._slip) != len(rows.phi):
            self.reset()
            self._slip = np.zeros(len(rows.phi))
        if self._before is not None:
            t_before, before, u = self._before
            elapsed = t - t_before
            if 0.0 < elapsed <= LONGEST_GAP * self.dt:
                share = min(1.0, elapsed / self.time)
                average_slip(before.phi, before.Lf_phi, before.Lg_phi, u, rows.phi, elapsed, share, self._slip)
        return BarrierRows(rows.h, rows.hdot, rows.phi, lowered(rows.Lf_phi, self._slip), rows.Lg_phi, rows.w)

    def applied(self, t: float, rows: BarrierRows, u: Array, short: float) -> None:
        """Torque u (nv,), gravity included, is applied from t on, where the rows are these.

        By ``short`` [m/s²] phi is known to change less than psi(u) says.
        """
        self._before = (t, BarrierRows(rows.h, rows.hdot, rows.phi, rows.Lf_phi - short, rows.Lg_phi, rows.w), u)


@kernel
def average_slip(phi: Any, Lf: Any, Lg: Any, u: Any, found: Any, elapsed: float, share: float, slip: Any) -> None:
    """Move ``slip`` (rows,) by ``share`` towards ``(phi + elapsed psi(u) - found) / elapsed``."""
    for k in range(len(phi)):
        psi = Lf[k]
        for j in range(len(u)):
            psi += Lg[k, j] * u[j]
        slip[k] += share * ((phi[k] - found[k]) / elapsed + psi - slip[k])


@kernel
def lowered(Lf: Any, slip: Any) -> Any:
    """``Lf - max(slip, 0)``, (rows,)."""
    out = np.empty(len(Lf))
    for k in range(len(Lf)):
        out[k] = Lf[k] - max(slip[k], 0.0)
    return out


class SlipBatch:
    """Observers of B runs that go in step; each learns what a :class:`SlipObserver` of its own would.

    Args:
        dt: control period [s].
        time: of the average [s].
        count: B.
    """

    def __init__(self, dt: float, time: float, count: int) -> None:
        self.dt, self.time = dt, time
        self._t = np.full(count, -np.inf)  # of the last step, where it says what to expect
        self._slip: Array | None = None
        self._before: list[Array] = []  # phi, L_f phi, L_g phi and torque then

    def wary(self, t: float, rows: BarrierRows) -> BarrierRows:
        """The rows at time t, leading axis B, with ``L_f phi`` lower by each run's slip."""
        if self._slip is None:
            self._slip = np.zeros_like(rows.phi)
        if self._before:
            phi, Lf, Lg, u = self._before
            average_slips(phi, Lf, Lg, u, rows.phi, t - self._t, LONGEST_GAP * self.dt, self.time, self._slip)
        return BarrierRows(rows.h, rows.hdot, rows.phi, rows.Lf_phi - np.maximum(self._slip, 0.0), rows.Lg_phi, rows.w)

    def applied(self, t: float, rows: BarrierRows, u: Array, short: Array, which: NDArray[np.bool_]) -> None:
        """Torques u (B, nv), gravity included, are applied from t on in the runs ``which`` (B,); ``short`` is (B,).

        The other runs' next states are compared with nothing.
        """
        self._before = [rows.phi, rows.Lf_phi - short[:, None], rows.Lg_phi, u]
        self._t = np.where(which, t, -np.inf)


@kernel
def average_slips(
    phi: Any, Lf: Any, Lg: Any, u: Any, found: Any, elapsed: Any, longest: float, time: float, slip: Any
) -> None:
    """:func:`average_slip` of every run whose last step is not too long ago."""
    for s in range(len(elapsed)):
        if 0.0 < elapsed[s] <= longest:
            share = min(1.0, elapsed[s] / time)
            average_slip(phi[s], Lf[s], Lg[s], u[s], found[s], elapsed[s], share, slip[s])
