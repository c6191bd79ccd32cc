"""One torque for a whole box of states: where to look for it, and bounds of what it does to a row.

A row, written as a form of the state for a given torque, has to be at least zero on the part of the box that lies on
the band. The band is where ``phi`` of a row lies in [0, epsilon]: two linear inequalities on the box, up to phi's
remainder, so the least value of a linear form there is a linear program with one constraint, whose dual is a maximum
over a few candidates.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ppcbf_robots.kernels import exact_kernel
from ppcbf_robots.proof import affine

_PARALLEL = 1e-12  # determinant below which three planes do not meet in a point
_CLOSE = 1e-9  # by which a candidate may miss a constraint: it is judged again, with bounds
JOINTS = 2  # the search is written for so many torques


@exact_kernel
def least(f: Any, phi: Any, low: bool, high: bool, epsilon: float) -> tuple[float, float]:
    """A lower bound of a form where ``phi >= 0`` (if ``low``) and ``phi <= epsilon`` (if ``high``), and its multiplier.

    For every multiplier λ of phi, ``f >= f0 - Σ |f_i - λ phi_i| - r + λ (bound of phi - phi0)``.
    """
    n = len(f) - 1
    best, at = -np.inf, 0.0
    for candidate in range(n):
        multiplier = 0.0
        if candidate > 0:
            if phi[candidate] == 0.0:
                continue
            multiplier = f[candidate] / phi[candidate]
        if (multiplier > 0.0 and not low) or (multiplier < 0.0 and not high):
            continue
        value, size = f[0] - f[n], abs(f[0]) + f[n]
        for i in range(1, n):
            value -= abs(f[i] - multiplier * phi[i])
            size += abs(f[i]) + abs(multiplier * phi[i])
        if multiplier > 0.0:
            value += multiplier * (-phi[0] - phi[n])
        elif multiplier < 0.0:
            value += multiplier * (epsilon - phi[0] + phi[n])
        size += abs(multiplier) * (abs(phi[0]) + phi[n] + epsilon)
        value -= affine.ROUNDING * size
        if value > best:
            best, at = value, multiplier
    return best, at


@exact_kernel
def point_on_band(phi: Any, epsilon: float, point: Any) -> None:
    """A point (S,) of [-1, 1]^S where the linear part of phi lies in [0, epsilon], as near the centre as may be."""
    n = len(phi) - 1
    wanted = min(max(phi[0], 0.0), epsilon) - phi[0]
    reach = 0.0
    for i in range(1, n):
        reach += abs(phi[i])
    share = min(1.0, max(-1.0, wanted / reach)) if reach > 0.0 else 0.0
    for i in range(1, n):
        point[i - 1] = math.copysign(share, phi[i] * share) if phi[i] != 0.0 else 0.0


@exact_kernel
def best_torque(A: Any, B: Any, weight: Any, count: int, u_max: Any, u: Any) -> float:
    """Maximise t over ``A_k + B_k u >= t weight_k`` and ``|u| <= u_max``; u (2,) receives the torque.

    ``weight_k = 0`` makes a row a plain constraint. By trying all corners; -inf if there is none.

    Args:
        A, B, weight: (rows,), (rows, 2), (rows,), of which the first ``count`` are used.
        u_max: (2,).
    """
    m = count + 2 * JOINTS
    planes = np.zeros((m, 4))  # of z = u / u_max and t: the first three dotted with (z, t) are at least the last
    for k in range(count):
        size = abs(A[k]) + abs(B[k, 0]) * u_max[0] + abs(B[k, 1]) * u_max[1] + affine.TINY
        planes[k, 0], planes[k, 1] = B[k, 0] * u_max[0] / size, B[k, 1] * u_max[1] / size
        planes[k, 2], planes[k, 3] = -weight[k] / size, -A[k] / size
    for j in range(JOINTS):
        planes[count + 2 * j, j], planes[count + 2 * j + 1, j] = 1.0, -1.0
        planes[count + 2 * j : count + 2 * j + 2, 3] = -1.0
    best = -np.inf
    u[:] = 0.0
    for i in range(count):
        if planes[i, 2] == 0.0:
            continue
        for j in range(m):
            if j == i or (j < i and planes[j, 2] != 0.0):
                continue  # met before in the other order
            for k in range(j + 1, m):
                if k == i or (k < i and planes[k, 2] != 0.0):
                    continue
                z0, z1, t, known = _corner(planes[i], planes[j], planes[k])
                if not known or t <= best:
                    continue
                inside = True
                for row in range(m):
                    p = planes[row]
                    inside = inside and p[0] * z0 + p[1] * z1 + p[2] * t >= p[3] - _CLOSE
                if inside:
                    best = t
                    u[0] = min(1.0, max(-1.0, z0)) * u_max[0]
                    u[1] = min(1.0, max(-1.0, z1)) * u_max[1]
    return best


@exact_kernel
def _corner(a: Any, b: Any, c: Any) -> tuple[float, float, float, bool]:
    """Where three planes meet, and whether they do in one point."""
    d0 = b[1] * c[2] - b[2] * c[1]
    d1 = b[2] * c[0] - b[0] * c[2]
    d2 = b[0] * c[1] - b[1] * c[0]
    det = a[0] * d0 + a[1] * d1 + a[2] * d2
    scale = (abs(a[0]) + abs(a[1]) + abs(a[2])) * (abs(d0) + abs(d1) + abs(d2))
    if not abs(det) > _PARALLEL * scale:
        return 0.0, 0.0, 0.0, False
    x = a[3] * d0 - a[1] * (b[3] * c[2] - b[2] * c[3]) - a[2] * (b[1] * c[3] - b[3] * c[1])
    y = a[0] * (b[3] * c[2] - b[2] * c[3]) + a[3] * d1 + a[2] * (b[0] * c[3] - b[3] * c[0])
    z = a[0] * (b[1] * c[3] - b[3] * c[1]) - a[1] * (b[0] * c[3] - b[3] * c[0]) + a[3] * d2
    return x / det, y / det, z / det, True
