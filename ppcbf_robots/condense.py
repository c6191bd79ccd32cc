"""Rows of the barrier and of the runtime QP at one state, compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ppcbf_robots.kernels import kernel


@kernel
def class_k(hdot: float, phi: float, alpha: float, release: float, margin: float) -> float:
    """What phi_k may fall by per second: the gain of a pair that separates rises from alpha to alpha + release."""
    return alpha * (phi - margin) + release * max(0.0, min(hdot, phi))


@kernel
def tolerated(phi: float, alpha: float, margin: float, share: float) -> float:
    """By how much psi_k may miss that for what K does in a period [m/s²]: phi settles above 0 all the same."""
    return alpha * (share * margin + max(0.0, phi - margin))


@kernel
def condense(
    hdot: Any, phi: Any, Lf: Any, Lg: Any, Minv: Any, b: Any, v: Any, v_domain: Any, u_des: Any, u_max: Any,
    low: Any, high: Any, alpha: float, release: float, speed_alpha: float, margin: float, flat: float,
    tolerance: float,
    C: Any, lower: Any, norm: Any, binding: Any,
) -> tuple[int, bool]:  # fmt: skip
    """Fill the rows ``C z >= lower`` of ``z = (u - u_des) / u_max``.

    Rows 0 to R are ``psi_k(u) >= -alpha (phi_k - margin) - release max(0, min(ḣ_k, phi_k))``, see :func:`class_k`.
    Then follow for every joint of ``v_domain``
    ``v̇ >= -speed_alpha (v - lowest)`` and ``-v̇ >= -speed_alpha (highest - v)``, which keep it in the velocity domain.

    Args:
        hdot, phi, Lf: (R,).
        Lg: (R, nv).
        Minv, b, v: of the state.
        v_domain: (nv, 2), or (0, 2) for no such rows.
        u_des, u_max: (nv,).
        low, high: (nv,) bounds of z.
        alpha: class-K gain [1/s].
        release: what joins it for pairs that separate [1/s].
        speed_alpha: that of the velocity domain [1/s].
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
            slack = Lf[k] + class_k(hdot[k], phi[k], alpha, release, margin)
        else:
            slack = speed_alpha * sign * (v[joint] - v_domain[joint, 0 if sign > 0 else 1])
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
            center += 0.5 * C[k, j] * (low[j] + high[j])
            reach += 0.5 * abs(C[k, j]) * (high[j] - low[j])
        binding[k] = lower[k] > center - reach
        hold = hold and slack >= 0.0
        if k < R and lower[k] > center + reach + tolerance and (hopeless < 0 or lower[k] > worst):
            hopeless, worst = k, lower[k]
    return hopeless, hold


@kernel
def hessian(Minv: Any, u_max: Any, kinetic: bool) -> Any:
    """``W`` in the dimensionless correction, M⁻¹ or 1 scaled by u_max on both sides, with mean diagonal 1."""
    n = len(u_max)
    H, trace = np.zeros((n, n)), 0.0
    for i in range(n):
        for j in range(n):
            if kinetic or i == j:
                H[i, j] = (Minv[i, j] if kinetic else 1.0) * u_max[i] * u_max[j]
        trace += H[i, i]
    return H * (n / trace)


@kernel
def dimensionless(
    hdot: Any, phi: Any, Lf: Any, Lg: Any, Minv: Any, b: Any, v: Any, v_domain: Any, u_des: Any, u_max: Any,
    lowest: Any, highest: Any, kinetic: bool, alpha: float, release: float, speed_alpha: float, margin: float,
    flat: float, tolerance: float, C: Any, lower: Any, norm: Any, binding: Any, low: Any, high: Any,
) -> tuple[int, bool, Any]:  # fmt: skip
    """:func:`condense` with the box of z, low and high (nv,), from torques ``lowest`` and ``highest`` (nv,).

    Returns what that does, u_des within its bounds being one more thing that has to hold, and :func:`hessian`.
    """
    inside = True
    for j in range(len(v)):
        low[j], high[j] = (lowest[j] - u_des[j]) / u_max[j], (highest[j] - u_des[j]) / u_max[j]
        inside = inside and low[j] <= 0.0 and high[j] >= 0.0
    hopeless, hold = condense(
        hdot, phi, Lf, Lg, Minv, b, v, v_domain, u_des, u_max, low, high, alpha, release, speed_alpha, margin, flat,
        tolerance, C, lower, norm, binding,
    )  # fmt: skip
    return hopeless, hold and inside, hessian(Minv, u_max, kinetic)


@kernel
def hold_at(
    hdot: Any, phi: Any, Lf: Any, Lg: Any, Minv: Any, b: Any, v: Any, v_domain: Any, u_des: Any, u_max: Any,
    alpha: float, release: float, speed_alpha: float, margin: float, flat: float, tolerance: float, hold: Any,
) -> None:  # fmt: skip
    """Whether all rows of :func:`condense` hold at u_des, and u_des is in the box, for a batch: hold (B,) is filled."""
    count, nv = phi.shape[1] + 2 * len(v_domain), len(u_max)
    C, lower, norm, binding = np.empty((count, nv)), np.empty(count), np.empty(count), np.empty(count, dtype=np.bool_)
    for s in range(len(v)):
        low, high = -1.0 - u_des[s] / u_max, 1.0 - u_des[s] / u_max
        _, hold[s] = condense(
            hdot[s], phi[s], Lf[s], Lg[s], Minv[s], b[s], v[s], v_domain, u_des[s], u_max, low, high,
            alpha, release, speed_alpha, margin, flat, tolerance, C, lower, norm, binding,
        )  # fmt: skip
        for j in range(nv):
            hold[s] = hold[s] and low[j] <= 0.0 and high[j] >= 0.0


@kernel
def nearest(lower: Any, binding: Any, count: int) -> Any:
    """Indices, rising, of the ``count`` binding rows most in need of a correction; row 0 if none binds."""
    found, size = np.zeros(max(1, count), dtype=np.int64), 0  # the most in need first
    for k in range(len(lower)):
        if binding[k] and (size < count or lower[k] > lower[found[size - 1]]):
            size = min(size + 1, count)
            at = size - 1
            while at > 0 and lower[found[at - 1]] < lower[k]:
                found[at] = found[at - 1]
                at -= 1
            found[at] = k
    return np.sort(found[: max(1, size)])


@kernel
def pick(C: Any, lower: Any, chosen: Any, row: Any, bound: float, with_row: bool) -> tuple[Any, Any]:
    """The chosen rows and their bounds in arrays of their own, with one more row (nv,) at the end if asked for."""
    count, nv = len(chosen), C.shape[1]
    rows, bounds = np.empty((count + (1 if with_row else 0), nv)), np.empty(count + (1 if with_row else 0))
    for i in range(count):
        bounds[i] = lower[chosen[i]]
        for j in range(nv):
            rows[i, j] = C[chosen[i], j]
    if with_row:
        bounds[count] = bound
        for j in range(nv):
            rows[count, j] = row[j]
    return rows, bounds


@kernel
def near(C: Any, lower: Any, binding: Any, count: int, row: Any, bound: float, with_row: bool) -> tuple[Any, Any, Any]:
    """Indices of the :func:`nearest` rows, and what :func:`pick` makes of them."""
    chosen = nearest(lower, binding, count)
    rows, bounds = pick(C, lower, chosen, row, bound, with_row)
    return chosen, rows, bounds


@kernel
def verify(C: Any, lower: Any, binding: Any, z: Any, tolerance: float, missed: Any) -> tuple[int, int, float]:
    """Check a correction against all rows: (number of rows missed, row of least residual, that residual).

    A row is missed if it binds and falls short by more than ``tolerance max(1, |lower|)``; missed (rows,) is filled.
    """
    count, tightest, least = 0, -1, np.inf
    for k in range(len(lower)):
        residual = -lower[k]
        for j in range(len(z)):
            residual += C[k, j] * z[j]
        missed[k] = binding[k] and not residual >= -tolerance * max(1.0, abs(lower[k]))
        count += missed[k]
        if residual < least:
            tightest, least = k, residual
    return count, tightest, least


@kernel
def accept(
    C: Any, lower: Any, binding: Any, low: Any, high: Any, row: Any, bound: float, with_row: bool, tolerance: float,
    answer: Any, missed: Any,
) -> tuple[Any, int, int, float]:  # fmt: skip
    """A solver's answer (nv,) put into the box, and what :func:`verify` says of it; -1 rows if the one more fails."""
    z, power = np.empty(len(answer)), 0.0
    for j in range(len(z)):
        z[j] = min(max(answer[j], low[j]), high[j])
        power += row[j] * z[j]
    if with_row and not power >= bound - tolerance:
        return z, -1, -1, np.inf
    count, tightest, least = verify(C, lower, binding, z, tolerance, missed)
    return z, count, tightest, least


@kernel
def inside(z: Any, low: Any, high: Any, tolerance: float) -> bool:
    """Whether every entry of z (n,) is finite and within its bounds."""
    found = True
    for i in range(len(z)):
        found = found and low[i] - tolerance <= z[i] <= high[i] + tolerance
    return found


@kernel
def power_row(v: Any, u_max: Any, budget: float, tiny: float) -> tuple[Any, float, bool]:
    """``vᵀ δ <= budget`` as a row (nv,) of z, of length 1, and its lower bound; whether it is one at all."""
    row, square = np.empty(len(v)), 0.0
    for j in range(len(v)):
        row[j] = -v[j] * u_max[j]
        square += row[j] * row[j]
    norm = math.sqrt(square)
    if norm < tiny:
        return row, 0.0, False
    return row / norm, -budget / norm, True


@kernel
def rho_rows_at(
    h: Any, grad: Any, drift: Any, curvature: Any, v: Any, M: Any, Minv: Any, Cv: Any, b: Any, gamma: float, K: float,
    K_q_rate: float, K_v: Any, energy: float,
) -> tuple[Any, Any, Any, Any, Any]:  # fmt: skip
    """ḣ, phi, L_f phi (R,), L_g phi and w (R, nv) of :func:`ppcbf_robots.barriers.rho_rows` at one state.

    K and its derivatives are without the share ``energy`` of the kinetic energy, which is added here.
    """
    R, nv = grad.shape
    hdot, phi, Lf, w = np.empty(R), np.empty(R), np.empty(R), np.empty((R, nv))
    slope = np.empty(nv)
    for i in range(nv):
        momentum = 0.0
        for j in range(nv):
            momentum += M[i, j] * v[j]
        slope[i] = K_v[i] + energy * momentum
        K += 0.5 * energy * momentum * v[i]
        K_q_rate += energy * v[i] * Cv[i]  # ½ vᵀ Ṁ v = vᵀ C v
    for k in range(R):
        hdot[k] = drift[k]
        for j in range(nv):
            hdot[k] += grad[k, j] * v[j]
            w[k, j] = grad[k, j] - slope[j]
    Lg = np.dot(w, Minv)
    for k in range(R):
        bias = 0.0
        for j in range(nv):
            bias += Lg[k, j] * b[j]
        phi[k] = hdot[k] + gamma * h[k] - K
        Lf[k] = curvature[k] + gamma * hdot[k] - K_q_rate - bias
    return hdot, phi, Lf, Lg, w


@kernel
def survey(h: Any, phi: Any, Lf: Any, Lg: Any, u_des: Any) -> tuple[bool, float, float]:
    """Whether the barrier's rows and u_des (nv,) are finite, and where they are, the least h and phi of the rows."""
    finite, least_h, least_phi = True, math.inf, math.inf
    for k in range(len(phi)):
        total = h[k] + phi[k] + Lf[k]
        for j in range(Lg.shape[1]):
            total += Lg[k, j]
        finite = finite and math.isfinite(total)
        least_h, least_phi = min(least_h, h[k]), min(least_phi, phi[k])
    for j in range(len(u_des)):
        finite = finite and math.isfinite(u_des[j])
    return finite, least_h, least_phi


@kernel
def falling_short(
    C: Any, lower: Any, norm: Any, phi: Any, z: Any, short: float, alpha: float, margin: float, share: float,
    flat: float,
) -> Any:  # fmt: skip
    """Indices, rising, of the barrier's rows that a correction z leaves less than what is :func:`tolerated`.

    The rows are those of :func:`condense`, with ``short`` taken off psi_k.
    """
    missed = np.empty(len(phi), dtype=np.bool_)
    for k in range(len(phi)):
        residual = -lower[k]
        for j in range(len(z)):
            residual += C[k, j] * z[j]
        missed[k] = residual * max(norm[k], flat) + tolerated(phi[k], alpha, margin, share) < short
    return np.flatnonzero(missed)
