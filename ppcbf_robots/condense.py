"""Rows of the runtime QP, compiled: from phi and its derivatives to rows of length 1 in the scaled correction."""

from __future__ import annotations

import math
from typing import Any

from ppcbf_robots.kernels import kernel


@kernel
def condense(
    phi: Any, Lf: Any, Lg: Any, Minv: Any, b: Any, v: Any, v_domain: Any, u_des: Any, u_max: Any,
    alpha: float, margin: float, flat: float, tolerance: float, C: Any, lower: Any, norm: Any, binding: Any,
) -> tuple[int, bool]:  # fmt: skip
    """Fill the rows ``C z >= lower`` of ``z = (u - u_des) / u_max``.

    Rows 0 to R are ``psi_k(u) >= -alpha (phi_k - margin)``, then follow for every joint of ``v_domain``
    ``v̇ >= -alpha (v - lowest)`` and ``-v̇ >= -alpha (highest - v)``, which keep it in the velocity domain.

    Args:
        phi, Lf: (R,).
        Lg: (R, nv).
        Minv, b, v: of the state.
        v_domain: (nv, 2), or (0, 2) for no such rows.
        u_des, u_max: (nv,).
        alpha: class-K gain [1/s].
        margin: kept off phi.
        flat: length of a row, in units of phi̇ per full torque, below which no torque steers it.
        tolerance: by which a row may be out of reach of the box before it counts as hopeless.
        C: (R + 2 nv, nv) receives the rows, of length 1.
        lower: (R + 2 nv,) receives their bounds.
        norm: (R + 2 nv,) receives their lengths before.
        binding: (R + 2 nv,) receives whether some torque in the box breaks the row.

    Returns:
        (index of the barrier row that no torque in the box satisfies, worst first, or -1; whether all hold at u_des).
    """
    R, nv = len(phi), len(v)
    hopeless, worst, hold = -1, -1.0, True
    for k in range(len(lower)):
        joint = (k - R) // 2
        sign = 1.0 if (k - R) % 2 == 0 else -1.0
        if k < R:
            slack = Lf[k] + alpha * (phi[k] - margin)
        else:
            slack = alpha * sign * (v[joint] - v_domain[joint, 0 if sign > 0 else 1])
        length = 0.0
        for j in range(nv):
            g = Lg[k, j] if k < R else sign * Minv[joint, j]
            slack += g * (u_des[j] if k < R else u_des[j] - b[j])
            C[k, j] = g * u_max[j]
            length += C[k, j] * C[k, j]
        norm[k] = math.sqrt(length)
        scale = max(norm[k], flat)
        lower[k] = -slack / scale
        center = reach = 0.0
        for j in range(nv):
            C[k, j] /= scale
            center -= C[k, j] * u_des[j] / u_max[j]
            reach += abs(C[k, j])
        binding[k] = lower[k] > center - reach
        hold = hold and slack >= 0.0
        if k < R and lower[k] > center + reach + tolerance and (hopeless < 0 or lower[k] > worst):
            hopeless, worst = k, lower[k]
    return hopeless, hold
