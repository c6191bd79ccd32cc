"""Many small linear programs at once, exactly: the best worst row that a torque in the box can give.

For every state b of a batch::

    max_z min_k offset_k + c_k · z    s.t.  |z_i| <= 1,  p · z <= budget

is solved through its dual, ``min λ · offset + mu budget + Σ_i |(Cᵀλ - mu p)_i|`` over ``λ >= 0, Σ λ = 1, mu >= 0``, by
the simplex method on one dense tableau per state, in float64. It starts from the single worst row, which is a feasible
basis, and most programs end after a handful of pivots. On a CPU they are solved compiled, one after the other, which is
ten times faster there; elsewhere all pivot together, by the same rules.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from ppcbf_robots.learning import simplex_kernel
from ppcbf_robots.learning.simplex_kernel import PIVOTS, TIE, TOLERANCE
from ppcbf_robots.learning.threads import in_threads


class Optimum(NamedTuple):
    """Solutions of B programs with R rows in n variables."""

    value: torch.Tensor  # (B,)
    share: torch.Tensor  # (B, R) multipliers λ of the rows, summing to 1
    z: torch.Tensor  # (B, n)

    def select(self, index: torch.Tensor) -> Optimum:
        """Those of some programs."""
        return Optimum(*(x[index] for x in self))


@torch.no_grad()
def best_worst_row(offset: torch.Tensor, c: torch.Tensor, p: torch.Tensor, budget: torch.Tensor) -> Optimum:
    """Solve all programs.

    Args:
        offset: (B, R).
        c: (B, R, n).
        p: (B, n), with ``Σ |p_i| <= 1`` or so.
        budget: (B,), at least ``-Σ |p_i|``: less has no solution.
    """
    offset, c, p, budget = offset.double(), c.double(), p.double(), budget.double()
    if offset.device.type != "cpu":
        return pivot_together(offset, c, p, budget)
    found = Optimum(torch.empty_like(offset[:, 0]), torch.empty_like(offset), torch.empty_like(p))
    arrays = [x.contiguous().numpy() for x in (offset, c, p, budget, *found)]
    in_threads(len(offset), lambda part: simplex_kernel.solve(*(x[part] for x in arrays)))
    return found


@torch.no_grad()
def pivot_together(offset: torch.Tensor, c: torch.Tensor, p: torch.Tensor, budget: torch.Tensor) -> Optimum:
    """:func:`best_worst_row` in float64, on any device."""
    (B, R), n = offset.shape, c.shape[-1]
    T, basis = _tableau(offset, c, p, budget)
    batch, columns = torch.arange(B, device=c.device), T.shape[-1] - 1
    for _ in range(PIVOTS):
        reduced, entering = T[:, n + 1, :columns].min(-1)
        column = T.gather(2, entering[:, None, None].expand(-1, n + 2, 1))[..., 0]
        steep = column[:, : n + 1] > TOLERANCE
        improves = (reduced < -TOLERANCE) & steep.any(-1)  # not steep: no solution, by rounding of the budget
        if not improves.any():
            break
        ratio = torch.where(steep, T[:, : n + 1, columns].clamp(min=0.0) / torch.where(steep, column[:, : n + 1], 1.0),
                            torch.inf)  # fmt: skip
        tied = ratio <= ratio.amin(-1, keepdim=True) + TIE  # of these the largest pivot: a tiny one is rounding noise
        leaving = torch.where(tied, column[:, : n + 1], 0.0).argmax(-1)
        pivot = column[batch, leaving]
        row = T[batch, leaving] / torch.where(improves, pivot, 1.0)[:, None]
        factor = column.clone()
        factor[batch, leaving] -= 1.0  # so that the pivot row becomes ``row`` itself
        T -= (factor * improves[:, None])[..., None] * row[:, None, :]
        basis[batch, leaving] = torch.where(improves, entering, basis[batch, leaving])
    solution = T.new_zeros(B, columns).scatter(1, basis, T[:, : n + 1, columns])
    first = R + 1
    z = 0.5 * (T[:, n + 1, first + n : columns] - T[:, n + 1, first : first + n])  # the multipliers of Cᵀλ - mu p
    return Optimum(-T[:, n + 1, columns], solution[:, :R], z)


def _tableau(
    offset: torch.Tensor, c: torch.Tensor, p: torch.Tensor, budget: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tableaus (B, n + 2, R + 1 + 2 n + 1) reduced to a feasible basis, and that basis (B, n + 1).

    Columns: λ (R), mu, the parts of ``Cᵀλ - mu p`` above (n) and below zero (n), right side. Rows: the n equations that
    define these parts, ``Σ λ = 1``, costs.
    """
    (B, R), n = offset.shape, c.shape[-1]
    above, below, right = R + 1, R + 1 + n, R + 1 + 2 * n
    T = offset.new_zeros(B, n + 2, right + 1)
    eye = torch.eye(n, dtype=T.dtype, device=T.device)
    T[:, :n, :R], T[:, :n, R] = c.transpose(1, 2), -p
    T[:, :n, above:below], T[:, :n, below:right] = -eye, eye
    T[:, n, :R] = T[:, n, right] = 1.0
    T[:, n + 1, :R], T[:, n + 1, R], T[:, n + 1, above:right] = offset, budget, 1.0
    batch = torch.arange(B, device=T.device)
    worst = (offset + c.abs().sum(-1)).argmin(-1)
    c_worst = c[batch, worst]
    T[:, :n] -= c_worst[..., None] * T[:, n : n + 1]
    positive = c_worst >= 0.0
    T[:, :n] *= torch.where(positive, -1.0, 1.0)[..., None]
    joints = torch.arange(n, device=T.device)
    basis = torch.cat([torch.where(positive, above, below) + joints, worst[:, None]], -1)
    cost = torch.cat([T.new_ones(B, n), offset[batch, worst][:, None]], -1)
    T[:, n + 1] -= (cost[..., None] * T[:, : n + 1]).sum(1)
    return T, basis
