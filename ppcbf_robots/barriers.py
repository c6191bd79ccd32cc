"""The four barriers behind one interface: phi, L_f phi, L_g phi for every row of a safety function.

========== ================================ ==========================================================
LB-CBF     ``phi = ḣ + gamma h``            blind to torque limits and passivity (eq. 10)
NCBF       ``phi = ḣ + gamma h - K_theta``  K trained for torque limits (eq. 11, 25)
PP-NCBF    ``phi = ḣ + gamma h - K_theta``  K trained for torque limits and passivity
PP-CBF     ``phi = alpha_pp h - ½ vᵀ M v``  Califano's, enforced as ``phi̇ >= -gamma_K phi``
========== ================================ ==========================================================

With ``w = ∇_v phi``: ``L_g phi = wᵀ M⁻¹`` and ``psi(x, u) = phi̇ = L_f phi + L_g phi u``. phi of the first three is in
m/s, of the last in J.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from ppcbf_robots.condense import rho_rows_at
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.robot import Dynamics, RobotModel
from ppcbf_robots.safety import SafetyRows
from ppcbf_robots.specs import Array, BarrierSpec

BarrierKind = Literal["lb-cbf", "ncbf", "pp-ncbf", "pp-cbf"]


@dataclass(frozen=True)
class BarrierRows:
    """Values of all rows of a barrier at one state; leading batch axes are allowed."""

    h: Any  # (..., rows)
    hdot: Any  # (..., rows)
    phi: Any  # (..., rows)
    Lf_phi: Any  # (..., rows)
    Lg_phi: Any  # (..., rows, nv)
    w: Any  # (..., rows, nv) = ∇_v phi, so that Lg_phi = wᵀ M⁻¹

    def psi(self, u: Any) -> Any:
        """phi̇ under torque u (..., nv): (..., rows)."""
        return self.Lf_phi + (self.Lg_phi @ u[..., None])[..., 0]


def rho_rows(
    h: Any, hdot: Any, grad: Any, curvature: Any, Minv: Any, b: Any, gamma: float, K: Any, K_q_rate: Any, K_v: Any
) -> BarrierRows:
    """Rows of ``phi = ḣ + gamma h - K`` for numpy or torch arrays.

    K (...), K_q_rate (...) = ∂K/∂q · q̇, K_v (..., nv) = ∂K/∂v; b = C v + g.
    """
    w = grad - K_v[..., None, :]
    Lg_phi = w @ Minv
    Lf_phi = curvature + gamma * hdot - K_q_rate[..., None] - (Lg_phi @ b[..., None])[..., 0]
    return BarrierRows(h, hdot, hdot + gamma * h - K[..., None], Lf_phi, Lg_phi, w)


class Barrier(Protocol):
    """What a filter needs of a barrier."""

    kind: BarrierKind
    spec: BarrierSpec

    def rows(self, dyn: Dynamics, safety: SafetyRows) -> BarrierRows:
        """All rows at one state (or batch)."""
        ...


class RhoBarrier:
    """LB-CBF (no network), NCBF and PP-NCBF."""

    def __init__(
        self, kind: BarrierKind, robot: RobotModel, spec: BarrierSpec, network: NumpyNetwork | None = None
    ) -> None:
        self.kind, self.robot, self.spec, self.network = kind, robot, spec, network

    def rows(self, dyn: Dynamics, safety: SafetyRows) -> BarrierRows:
        """Eq. (10), (11), (25) of the paper."""
        gamma, network = self.spec.gamma, self.network
        if network is None:
            K, K_v = np.zeros(dyn.v.shape[:-1]), np.zeros_like(dyn.v)
            K_q_rate, energy = K, 0.0
        else:
            K, K_q, K_v = network.value_and_grad(dyn.q, dyn.v)
            K_q_rate, energy = (K_q * self.robot.q_rate(dyn.q, dyn.v)).sum(-1), network.energy
        if dyn.v.ndim > 1:
            Mv = (dyn.M @ dyn.v[..., None])[..., 0]
            K = K + 0.5 * energy * (dyn.v * Mv).sum(-1)
            K_q_rate = K_q_rate + energy * (dyn.v * dyn.Cv).sum(-1)  # ½ vᵀ Ṁ v = vᵀ C v
            K_v = K_v + energy * Mv
            hdot = safety.hdot(dyn.v)
            return rho_rows(safety.h, hdot, safety.grad, safety.curvature, dyn.Minv, dyn.b, gamma, K, K_q_rate, K_v)
        found = rho_rows_at(
            safety.h, safety.grad, safety.drift, safety.curvature, dyn.v, dyn.M, dyn.Minv, dyn.Cv, dyn.b, gamma,
            float(K), float(K_q_rate), K_v, energy,
        )  # fmt: skip
        return BarrierRows(safety.h, *found)


class EnergyBarrier:
    """PP-CBF of Califano (arXiv:2303.10981), one row per safety function."""

    kind: BarrierKind = "pp-cbf"

    def __init__(self, spec: BarrierSpec) -> None:
        self.spec = spec

    def rows(self, dyn: Dynamics, safety: SafetyRows) -> BarrierRows:
        """``phi = alpha h - T`` and ``d/dt ½ vᵀ M v = vᵀ (u - g)``, so ``L_g phi = -vᵀ``."""
        alpha = self.spec.alpha_pp
        Lf_phi = alpha * safety.hdot(dyn.v) + (dyn.v * dyn.g).sum(-1)[..., None]
        Lg_phi: Array = np.broadcast_to(-dyn.v[..., None, :], safety.grad.shape)
        Mv = (dyn.M @ dyn.v[..., None])[..., 0]
        w = np.broadcast_to(-Mv[..., None, :], safety.grad.shape)
        phi = alpha * safety.h - dyn.kinetic_energy[..., None]
        return BarrierRows(safety.h, safety.hdot(dyn.v), phi, Lf_phi, Lg_phi, w)
