"""Critics: how far a band state is from satisfying the torque box and passivity, without dimensions.

``closed_form_critics`` are the paper's (17) and (18) for the correction (13); ``feasibility_margin`` is that of the
runtime QP. Positive margins are good, positive critics bad.
"""

from __future__ import annotations

from typing import Any

import torch

from ppcbf_robots.barriers import BarrierRows
from ppcbf_robots.filters import Metric

_TINY = 1e-9
PASSIVITY_RESERVE = 0.01  # of |v| |u_sc|; more of it fights the torque critic
DESCENTS = 25  # mirror descent steps towards the worst combination of rows
DESCENT_RATE = 3.0


def least_row(rows: BarrierRows) -> BarrierRows:
    """The row of least phi of every state, keeping an axis of length 1."""
    k = rows.phi.argmin(-1, keepdim=True)
    wide = k[..., None].expand(-1, -1, rows.Lg_phi.shape[-1])
    return BarrierRows(
        rows.h.gather(-1, k),
        rows.phi.gather(-1, k),
        rows.Lf_phi.gather(-1, k),
        rows.Lg_phi.gather(-2, wide),
        rows.w.gather(-2, wide),
    )


def closed_form_critics(
    rows: BarrierRows, v: Any, u_des: Any, d_p: Any, u_max: Any, metric: Metric, margin: float, p_ref: float
) -> tuple[Any, Any]:
    """Torque critic (18) relative to u_max and passivity critic (17) relative to p_ref [W], (B,) each.

    The torque critic asks for ``margin`` in reserve, the passivity critic for a hundredth of |v| |u_sc|. They are
    zero where psi(u_des) >= 0, since nothing is corrected there.
    """
    row = least_row(rows)
    psi = row.psi(u_des)[:, 0]
    Lg, w = row.Lg_phi[:, 0], row.w[:, 0]
    direction = Lg if metric == "torque" else w
    u_sc = -torch.minimum(psi, torch.zeros_like(psi))[:, None] * direction / ((Lg * direction).sum(-1) + _TINY)[:, None]
    u = u_des + u_sc
    acts = (psi < 0.0).to(u.dtype)
    torque = torch.relu(u.abs() / u_max - (1.0 - margin)).amax(-1) * acts
    power = (v * u_sc).sum(-1) - d_p
    size = v.norm(dim=-1) * u_sc.norm(dim=-1)
    reserve = PASSIVITY_RESERVE if margin else 0.0
    passivity = torch.relu(power + reserve * size) / p_ref * acts
    return torque, passivity


def feasibility_margin(
    rows: BarrierRows, v: Any, u_des: Any, d_p: Any, u_max: Any, alpha: float, passive: bool
) -> tuple[Any, Any]:
    """Margin of all rows together with torque box and passivity row, (B,), and of box with passivity alone, (B,).

    ``max_u min_k (psi_k(u) + alpha phi_k) / authority_k`` over ``|u| <= u_max``, ``vᵀ(u - u_des) <= d_p``. By duality
    it is the least margin over all convex combinations of the rows. The combination is found by mirror descent and held
    fixed for the gradient (envelope theorem); the margin of the combined row is exact, so what is returned is an upper
    bound, exact for one row.
    """
    authority = (rows.Lg_phi.abs() * u_max).sum(-1) + _TINY
    level = rows.phi.detach()  # states are drawn at a level of phi: moving the level is no way to gain margin
    offset = (rows.Lf_phi + alpha * level) / authority  # (B, R)
    c = rows.Lg_phi / authority[..., None]  # (B, R, nv)
    budget = (v * u_des).sum(-1) + d_p if passive else None  # (B,): vᵀu <= budget
    with torch.no_grad():
        share = _worst_combination(offset, c, v, budget, u_max)
    combined = (share[..., None] * c).sum(-2)
    margin = (share * offset).sum(-1) + _largest(combined, v, budget, u_max)[0]
    if budget is None:
        return margin, torch.ones_like(margin)
    power = (v.abs() * u_max).sum(-1)
    return margin, (budget + power) / (power + _TINY)


def _largest(c: Any, v: Any, budget: Any, u_max: Any) -> tuple[Any, Any]:
    """``max c·u`` over the box and ``vᵀu <= budget`` for c (B, nv), and the multiplier mu of the budget, (B,) each.

    The dual ``min_mu Σ_i |c_i - mu v_i| u_max_i + mu budget``, mu >= 0, is convex and piecewise linear: its least value
    is at 0 or at a breakpoint ``c_i / v_i > 0``. The breakpoints keep their gradient.
    """
    if budget is None:
        return (c.abs() * u_max).sum(-1), torch.zeros_like(c[..., 0])
    moving = v.abs() > 1e-6
    breakpoints = torch.relu(c / torch.where(moving, v, torch.ones_like(v))) * moving
    mu = torch.cat([torch.zeros_like(breakpoints[..., :1]), breakpoints], -1)  # (B, nv + 1)
    value = ((c[..., None, :] - mu[..., None] * v[..., None, :]).abs() * u_max).sum(-1) + mu * budget[..., None]
    best = value.min(-1)
    return best.values, mu.gather(-1, best.indices[..., None])[..., 0]


def _worst_combination(offset: Any, c: Any, v: Any, budget: Any, u_max: Any) -> Any:
    """Shares (B, R) of the rows, summing to 1, whose combination has the least margin."""
    rows = offset.shape[-1]
    if rows == 1:
        return torch.ones_like(offset)
    budgets = None if budget is None else budget.repeat_interleave(rows, 0)
    alone = _largest(c.flatten(0, 1), v.repeat_interleave(rows, 0), budgets, u_max)[0]
    single = offset + alone.view_as(offset)
    best, best_share = single.min(-1)
    best_share = torch.nn.functional.one_hot(best_share, rows).to(offset.dtype)
    logits = torch.zeros_like(offset)
    for t in range(DESCENTS):
        share = torch.softmax(logits, -1)
        combined = (share[..., None] * c).sum(-2)
        value, mu = _largest(combined, v, budget, u_max)
        margin = (share * offset).sum(-1) + value
        better = margin < best
        best, best_share = torch.where(better, margin, best), torch.where(better[..., None], share, best_share)
        reduced = combined if budget is None else combined - mu[..., None] * v
        u = (
            torch.tanh(reduced / (0.02 * reduced.abs().amax(-1, keepdim=True) + _TINY)) * u_max
        )  # smoothed best response
        logits = logits - DESCENT_RATE / (1.0 + t) ** 0.5 * (offset + (c * u[..., None, :]).sum(-1))
    return best_share
