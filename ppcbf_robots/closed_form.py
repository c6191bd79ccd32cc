"""The paper's corrections in closed form: eq. (8)/(13) of the barriers with K, and the PP-CBF's damper."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.barriers import Barrier, BarrierRows
from ppcbf_robots.filters import Box, Correction, FilterConfig, Status, acts_on
from ppcbf_robots.robot import Dynamics
from ppcbf_robots.safety import SafetyRows
from ppcbf_robots.specs import Array

_TINY = 1e-12


class ClosedForm:
    """Eq. (8)/(13) for the row of least phi; does not enforce the torque box (the barrier was trained to).

    Where the torque's rate is limited, :class:`ppcbf_robots.safety_filter.SafetyFilter` clips its answer to box and
    rate.
    """

    def __init__(self, barrier: Barrier, config: FilterConfig) -> None:
        self.barrier, self.config = barrier, config

    def _active(self, rows: BarrierRows) -> Array:
        spec = self.barrier.spec
        if self.barrier.kind != "pp-cbf":
            return np.asarray(acts_on(spec, rows.h, rows.phi))
        return np.ones_like(rows.h, dtype=bool) if spec.act_within is None else np.asarray(rows.h <= spec.act_within)

    def correct(
        self,
        dyn: Dynamics,
        safety: SafetyRows,
        rows: BarrierRows,
        u_des: Array,
        d_p: float | None,
        u_max: Array,
        allowed: Box | None = None,
    ) -> Correction:
        """The paper's correction; d_p and u_max do not enter it. ``allowed`` bounds clip it, and that is said."""
        answer = self._formula(dyn, safety, rows, u_des)
        u = answer.u if allowed is None else np.clip(answer.u, *allowed)
        if (u == answer.u).all():
            return answer
        if answer.status is Status.FREE:
            return Correction(u, Status.CORRECTING, "u_des clipped to box and rate", -1)
        return Correction(u, Status.INFEASIBLE, "the correction is clipped to box and rate", answer.row)

    def _formula(self, dyn: Dynamics, safety: SafetyRows, rows: BarrierRows, u_des: Array) -> Correction:
        active = np.flatnonzero(self._active(rows))
        if not active.size:
            return Correction(u_des, Status.FREE, "outside the band", -1)
        k = int(active[np.argmin(rows.phi[active])])
        if self.barrier.kind == "pp-cbf":
            return self._damp(dyn, safety, k, u_des)
        Lg = rows.Lg_phi[k]
        psi = float(rows.Lf_phi[k] + Lg @ u_des)
        if psi >= 0.0:
            return Correction(u_des, Status.FREE, "psi(u_des) >= 0", -1)
        direction = Lg if self.config.metric == "torque" else rows.w[k]
        gain = float(Lg @ direction)
        if gain < _TINY:
            return Correction(u_des, Status.INFEASIBLE, "L_g phi is zero: no torque changes phi", k)
        return Correction(u_des - psi / gain * direction, Status.CORRECTING, "psi(u_des) < 0", k)

    def violated(self, rows: BarrierRows, u: Array, limited: bool) -> NDArray[np.bool_]:
        """(rows,): whether a torque u (nv,) breaks the condition on the rows that are looked at."""
        gamma = self.barrier.spec.gamma_K if self.barrier.kind == "pp-cbf" else 0.0
        return np.asarray(self._active(rows) & (rows.psi(u) < -gamma * rows.phi))

    def passes(self, dyn: Dynamics, rows: BarrierRows, u_des: Array, u_max: Array) -> tuple[NDArray[np.bool_], Array]:
        """As :meth:`ppcbf_robots.qp_filter.QPFilter.passes`; nothing is known before each state is looked at."""
        return np.zeros(len(u_des), dtype=np.bool_), np.zeros(len(u_des))

    def _damp(self, dyn: Dynamics, safety: SafetyRows, k: int, u_des: Array) -> Correction:
        """PP-CBF: the least damper ``δ = -λ D v`` (D = I, or M in the kinetic metric), implicit over one period.

        L_g phi = -vᵀ vanishes at rest, where the explicit λ divides by |v|² and chatters (30 N m from tick to tick on
        the 2R). Here λ is the least one for which the condition holds at the velocity v⁺ the period ends with,
        ``(M + dt λ D) v⁺ = M v + dt (u_des - b)``: the paper's λ as dt -> 0, and a smooth stop at rest.
        """
        dt, spec = self.config.dt, self.barrier.spec
        momentum = dyn.M @ dyn.v + dt * (u_des - dyn.b)
        D = np.eye(len(u_des)) if self.config.metric == "torque" else dyn.M
        grad, drift, h = safety.grad[k], float(safety.drift[k]), float(safety.h[k])

        def damped(multiplier: float) -> tuple[float, Array]:
            """Residual of ``phi̇ >= -gamma_K phi`` and the correction, both at v⁺."""
            v = np.linalg.solve(dyn.M + dt * multiplier * D, momentum)
            correction = -multiplier * (D @ v)
            phi_dot = spec.alpha_pp * (grad @ v + drift) - v @ (u_des + correction - dyn.g)
            phi = spec.alpha_pp * h - 0.5 * v @ dyn.M @ v
            return float(phi_dot + spec.gamma_K * phi), correction

        if damped(0.0)[0] >= 0.0:
            return Correction(u_des, Status.FREE, "psi(u_des) >= -gamma_K phi", -1)
        low, high = 1e-3, 1e12  # relative to the inertia, from hardly any damper to a dead stop
        for _ in range(40):
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if damped(middle)[0] >= 0.0 else (middle, high)
        return Correction(u_des + damped(high)[1], Status.CORRECTING, "psi(u_des) < -gamma_K phi", k)
