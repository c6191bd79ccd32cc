"""The linear programs of :mod:`ppcbf_robots.learning.linear_program`, compiled for a CPU: one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np

from ppcbf_robots.kernels import kernel

PIVOTS = 60  # more than any program of 8 joints and 16 rows was seen to need
TOLERANCE = 1e-10  # reduced costs and pivots below it are rounding
TIE = 1e-11  # ratios so close are tied


@kernel
def _fill(offset: Any, c: Any, p: Any, budget: float, T: Any, basis: Any) -> None:
    """The tableau (n + 2, R + 2 n + 2), columns as there, reduced to the basis (n + 1,) of the worst row."""
    R, n = c.shape
    above, below, right = R + 1, R + 1 + n, R + 1 + 2 * n
    worst, least = 0, np.inf
    for k in range(R):
        reach = offset[k]
        for i in range(n):
            reach += abs(c[k, i])
        if reach < least:
            worst, least = k, reach
    T[:] = 0.0
    T[n, :R], T[n, right] = 1.0, 1.0
    T[n + 1, :R], T[n + 1, R], T[n + 1, above:right] = offset - offset[worst], budget, 1.0
    T[n + 1, right] = -offset[worst]
    for i in range(n):
        positive = c[worst, i] >= 0.0
        sign = -1.0 if positive else 1.0
        for k in range(R):
            T[i, k] = sign * (c[k, i] - c[worst, i])
        T[i, R], T[i, right] = -sign * p[i], -sign * c[worst, i]
        T[i, above + i], T[i, below + i] = -sign, sign
        basis[i] = above + i if positive else below + i
        for j in range(right + 1):
            T[n + 1, j] -= T[i, j]
    basis[n] = worst


@kernel
def _pivot(T: Any, basis: Any) -> bool:
    """One step of the simplex method, by the most negative reduced cost; whether there was one to take."""
    n, right = len(basis) - 1, T.shape[1] - 1
    entering, reduced = 0, T[n + 1, 0]
    for j in range(1, right):
        if T[n + 1, j] < reduced:
            entering, reduced = j, T[n + 1, j]
    if reduced >= -TOLERANCE:
        return False
    least = np.inf
    for i in range(n + 1):
        if T[i, entering] > TOLERANCE:
            least = min(least, max(T[i, right], 0.0) / T[i, entering])
    leaving, pivot = -1, 0.0
    for i in range(n + 1):  # of tied ratios the largest pivot: a tiny one is rounding noise
        x = T[i, entering]
        if x > TOLERANCE and x > pivot and max(T[i, right], 0.0) / x <= least + TIE:
            leaving, pivot = i, x
    if leaving < 0:  # no solution, by rounding of the budget
        return False
    for j in range(right + 1):
        T[leaving, j] /= pivot
    for i in range(n + 2):
        factor = T[i, entering]
        if i != leaving and factor != 0.0:
            for j in range(right + 1):
                T[i, j] -= factor * T[leaving, j]
    basis[leaving] = entering
    return True


@kernel
def solve(offset: Any, c: Any, p: Any, budget: Any, value: Any, share: Any, z: Any) -> None:
    """Fill value (B,), share (B, R) and z (B, n) of B programs; inputs as ``best_worst_row`` takes them, in float64."""
    (B, R), n = offset.shape, p.shape[1]
    above, below, right = R + 1, R + 1 + n, R + 1 + 2 * n
    T, basis = np.empty((n + 2, right + 1)), np.empty(n + 1, dtype=np.int64)
    for b in range(B):
        _fill(offset[b], c[b], p[b], budget[b], T, basis)
        for _ in range(PIVOTS):
            if not _pivot(T, basis):
                break
        value[b] = -T[n + 1, right]
        share[b] = 0.0
        for i in range(n + 1):
            if basis[i] < R:
                share[b, basis[i]] = T[i, right]
        for i in range(n):  # the multipliers of Cᵀλ - mu p
            z[b, i] = 0.5 * (T[n + 1, below + i] - T[n + 1, above + i])
