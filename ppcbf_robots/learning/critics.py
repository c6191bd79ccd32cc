"""Critics: how far a band state is from satisfying the torque box and passivity, without dimensions.

``closed_form_critics`` are the paper's (17) and (18) for the correction (13); ``feasibility`` gives the margin of the
runtime QP, exact for any number of rows. Positive margins are good, positive critics bad.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.filters import FilterConfig, Metric, acts_on
from ppcbf_robots.learning.linear_program import Optimum, best_worst_row
from ppcbf_robots.specs import BarrierSpec

_TINY = 1e-9
LEAST_CAPABILITY = 1e-3  # two rows that brake each other exactly leave none
PASSIVITY_RESERVE = 0.01  # of |v| |u_sc|; more of it fights the torque critic


def least_row(rows: BarrierRows, among: Any) -> BarrierRows:
    """The row of least phi of every state, ``among`` some (B, R), keeping an axis of length 1."""
    k = torch.where(among, rows.phi, torch.inf).argmin(-1, keepdim=True)
    wide = k[..., None].expand(-1, -1, rows.Lg_phi.shape[-1])
    return BarrierRows(
        rows.h.gather(-1, k),
        rows.hdot.gather(-1, k),
        rows.phi.gather(-1, k),
        rows.Lf_phi.gather(-1, k),
        rows.Lg_phi.gather(-2, wide),
        rows.w.gather(-2, wide),
    )


def closed_form_critics(
    rows: BarrierRows, v: Any, u_des: Any, d_p: Any, u_max: Any, metric: Metric, margin: float, p_ref: float,
    spec: BarrierSpec,
) -> tuple[Any, Any]:  # fmt: skip
    """Torque critic (18) relative to u_max and passivity critic (17) relative to p_ref [W], (B,) each.

    The torque critic asks for ``margin`` in reserve, the passivity critic for a hundredth of |v| |u_sc|. They are
    zero where psi(u_des) >= 0, since nothing is corrected there, and where the filter does not act: with ``act_within``
    in the spec the states may lie above its epsilon.
    """
    active = torch.ones_like(rows.phi, dtype=torch.bool)
    if spec.act_within is not None:
        active = acts_on(spec, rows.h, rows.phi)
    row = least_row(rows, active)
    psi = row.psi(u_des)[:, 0]
    Lg, w = row.Lg_phi[:, 0], row.w[:, 0]
    direction = Lg if metric == "torque" else w
    u_sc = -torch.minimum(psi, torch.zeros_like(psi))[:, None] * direction / ((Lg * direction).sum(-1) + _TINY)[:, None]
    u = u_des + u_sc
    acts = ((psi < 0.0) & active.any(-1)).to(u.dtype)
    torque = torch.relu(u.abs() / u_max - (1.0 - margin)).amax(-1) * acts
    power = (v * u_sc).sum(-1) - d_p
    size = v.norm(dim=-1) * u_sc.norm(dim=-1)
    reserve = PASSIVITY_RESERVE if margin else 0.0
    passivity = torch.relu(power + reserve * size) / p_ref * acts
    return torque, passivity


class Feasibility(NamedTuple):
    """The linear program of B states: rows ``offset + c z`` of R rows, ``|z_i| <= 1``, ``p z <= budget``."""

    offset: Any  # (B, R)
    c: Any  # (B, R, nv)
    p: Any  # (B, nv)
    budget: Any  # (B,)

    def solve(self) -> Optimum:
        """Multipliers and torques, without gradient."""
        offset, c, p, budget = (x.detach() for x in self)
        return best_worst_row(offset, c, p, budget.clamp(min=-1.0))

    def capability(self) -> Any:
        """(B,): the margin if no row asked for anything and power were free, without gradient.

        The torque limits' effect on the rows, all together. It is 1 for a row alone, and little where one row's torques
        are the opposite of another's, as of two joints in line that run into their limits. The *reserve*, the margin
        over it, is the share left of what could be done, of the margin's sign: near rest, or where little can be done
        but nothing is asked for, the margin itself is small however safe the state is.
        """
        offset, c, p = (x.detach() for x in (self.offset, self.c, self.p))
        free = best_worst_row(offset.clamp(min=0.0), c, p, torch.ones_like(p[:, 0])).value
        return free.clamp(min=LEAST_CAPABILITY).to(c.dtype)

    def margin(self, optimum: Optimum) -> Any:
        """(B,), with the envelope theorem's gradient: the optimum, of these very states, is held fixed."""
        share, z = optimum.share.to(self.c.dtype), optimum.z.to(self.c.dtype)
        margin = (share * (self.offset + (self.c * z[..., None, :]).sum(-1))).sum(-1)
        return torch.where(self.budget >= -1.0, margin, self.budget)


def feasibility(
    rows: BarrierRows, v: Any, u_des: Any, d_p: Any, u_max: Any, config: FilterConfig, passive: bool
) -> Feasibility:
    """The exact margin of the runtime QP's barrier rows, torque box and passivity row together, as a linear program.

    ``max_u min_k (psi_k(u) + alpha (phi_k - margin) + fast_alpha max(0, min(ḣ_k, phi_k))) / authority_k`` over
    ``|u| <= u_max``, ``vᵀ(u - u_des) <= d_p``, where
    ``authority_k = Σ_i |L_gφ_k,i| u_max,i`` makes it dimensionless. It is negative where the QP has no solution.
    Where not even the box alone allows the power, it is ``-1`` minus the power that is too much, relative to
    ``|v| · u_max``.

    Args:
        rows: of B states.
        v, u_des: (B, nv).
        d_p: (B,) [W], what is allowed beyond it included.
        u_max: (nv,).
        config: gains and margin of the filter.
        passive: whether the passivity row is asked for.
    """
    authority = (rows.Lg_phi.abs() * u_max).sum(-1) + _TINY
    level = rows.phi.detach()  # states are drawn at a level of phi: moving the level is no way to gain margin
    separating = torch.minimum(rows.hdot.detach(), level).clamp(min=0.0)
    wanted = config.alpha * (level - config.margin) + config.fast_alpha * separating
    offset = (rows.Lf_phi + wanted) / authority  # (B, R)
    c = rows.Lg_phi * u_max / authority[..., None]
    power = v * u_max
    scale = power.abs().sum(-1) + _TINY
    budget = ((v * u_des).sum(-1) + d_p) / scale if passive else torch.ones_like(d_p)
    return Feasibility(offset, c, power / scale[..., None], budget)
