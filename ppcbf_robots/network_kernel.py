"""K_theta and its gradient at one state, compiled: the formulas of :mod:`ppcbf_robots.network` written as loops.

Layers are row vectors times (inputs, outputs) matrices; ``weights`` holds all hidden layers one after the other, each
matrix row by row and then its bias, and ``widths`` their sizes, inputs first.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ppcbf_robots.kernels import kernel


@kernel
def _hidden(x: Any, weights: Any, widths: Any, slopes: Any) -> Any:
    """Output of the ELU layers; slopes (layers, widest) receives the derivative of every unit."""
    at = 0
    for layer in range(len(widths) - 1):
        inputs, outputs = widths[layer], widths[layer + 1]
        y = weights[at + inputs * outputs : at + inputs * outputs + outputs].copy()
        for i in range(inputs):
            row = weights[at + i * outputs : at + (i + 1) * outputs]
            for j in range(outputs):
                y[j] += x[i] * row[j]
        for j in range(outputs):
            slope = math.exp(y[j]) if y[j] < 0.0 else 1.0
            slopes[layer, j] = slope
            if y[j] < 0.0:
                y[j] = slope - 1.0
        at += (inputs + 1) * outputs
        x = y
    return x


@kernel
def _pull_back(g: Any, weights: Any, widths: Any, slopes: Any) -> Any:
    """Gradient with respect to the input from that with respect to the last hidden layer."""
    at, g = len(weights), g.copy()
    for layer in range(len(widths) - 2, -1, -1):
        inputs, outputs = widths[layer], widths[layer + 1]
        at -= (inputs + 1) * outputs
        scaled = g * slopes[layer, :outputs]
        g = np.empty(inputs)
        for i in range(inputs):
            row = weights[at + i * outputs : at + (i + 1) * outputs]
            total = 0.0
            for j in range(outputs):
                total += scaled[j] * row[j]
            g[i] = total
    return g


@kernel
def mlp(
    q: Any, v: Any, weights: Any, widths: Any, shift: Any, scale: Any, w_out: Any, b_out: float, rest: float
) -> Any:
    """K, ∂K/∂q and ∂K/∂v of ``K = (f(q, v) - rest f(q, 0) + (1 - rest) b_out)²``."""
    nq, n = len(q), len(q) + len(v)
    slopes, slopes0 = np.empty((len(widths), widths.max())), np.empty((len(widths), widths.max()))
    x, x0 = np.empty(n), np.empty(n)
    for i in range(n):
        x[i] = ((q[i] if i < nq else v[i - nq]) - shift[i]) * scale[i]
        x0[i] = ((q[i] if i < nq else 0.0) - shift[i]) * scale[i]
    y, y0 = _hidden(x, weights, widths, slopes), _hidden(x0, weights, widths, slopes0)
    d = (1.0 - rest) * b_out
    for j in range(len(y)):
        d += w_out[j] * (y[j] - rest * y0[j])
    g, g0 = _pull_back(w_out, weights, widths, slopes), _pull_back(w_out, weights, widths, slopes0)
    for i in range(n):
        g[i] = 2.0 * d * scale[i] * (g[i] - (rest * g0[i] if i < nq else 0.0))
    return d * d, g[:nq], g[nq:]


@kernel
def _softplus(x: float) -> float:
    return math.log1p(math.exp(-abs(x))) + max(x, 0.0)


@kernel
def _sigmoid(x: float) -> float:
    return 0.5 * (1.0 + math.tanh(0.5 * x))


@kernel
def _units(
    q: Any, weights: Any, widths: Any, shift: Any, scale: Any, turns: Any, Wa: Any, ba: Any, Wb: Any, bb: Any,
    Wc: Any, bc: Any, features: Any, slopes: Any,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """a before its softplus and c (units,), b (units, nv); the layers' input (3 nq,) and slopes are filled in."""
    nq, units, width = len(q), len(ba), widths[-1]
    nv = len(bb) // units
    for i in range(nq):
        angle = q[i] * turns[i]
        features[i] = (q[i] - shift[i]) * scale[i]
        features[nq + i], features[2 * nq + i] = math.cos(angle), math.sin(angle)
    x = _hidden(features, weights, widths, slopes)
    a, c, b = np.empty(units), np.empty(units), np.empty((units, nv))
    for u in range(units):
        a_u, c_u = ba[u], bc[u]
        for k in range(width):
            a_u += Wa[u, k] * x[k]
            c_u += Wc[u, k] * x[k]
        a[u], c[u] = a_u, c_u
        for j in range(nv):
            b_uj = bb[u * nv + j]
            for k in range(width):
                b_uj += Wb[u * nv + j, k] * x[k]
            b[u, j] = b_uj
    return a, c, b


@kernel
def _of_velocity(
    v: Any, a: Any, c: Any, b: Any, v_scale: Any, cone_a: Any, cone_b: Any, cone_c: Any, bowl_a: Any, bowl_b: Any,
    bowl_c: Any, K_v: Any, parts: Any,
) -> float:  # fmt: skip
    """K; ∂K/∂v (nv,) is filled in, and of every unit D and its derivatives with respect to z and c (units, 3)."""
    nv, round_ = len(v), _softplus(cone_c.item())
    root, bowl = round_**2, -bowl_c.item()
    for j in range(nv):
        s = v[j] * v_scale[j]
        root += (cone_b[j] * s) ** 2
        bowl += (bowl_b[j] * s) ** 2
    root, along_cone, along_bowl = math.sqrt(root), _softplus(cone_a.item()), _softplus(bowl_a.item())
    K = along_cone * (root - round_) + along_bowl * (_softplus(bowl) - _softplus(-bowl_c.item()))
    for j in range(nv):
        slope = along_cone / root * cone_b[j] ** 2 + 2.0 * along_bowl * _sigmoid(bowl) * bowl_b[j] ** 2
        K_v[j] = slope * v[j] * v_scale[j] ** 2
    for u in range(len(a)):
        z = 0.0
        for j in range(nv):
            z += b[u, j] * v[j] * v_scale[j]
        weight, sig, sig0 = _softplus(a[u]), _sigmoid(z + c[u]), _sigmoid(c[u])
        D = _softplus(z + c[u]) - _softplus(c[u]) - sig0 * z
        dz = weight * (sig - sig0)
        parts[u, 0], parts[u, 1], parts[u, 2] = D, dz, dz - weight * sig0 * (1.0 - sig0) * z
        K += weight * D
        for j in range(nv):
            K_v[j] += dz * b[u, j] * v_scale[j]
    return K


@kernel
def convex(
    q: Any, v: Any, weights: Any, widths: Any, shift: Any, scale: Any, turns: Any,
    Wa: Any, ba: Any, Wb: Any, bb: Any, Wc: Any, bc: Any,
    v_scale: Any, cone_a: Any, cone_b: Any, cone_c: Any, bowl_a: Any, bowl_b: Any, bowl_c: Any,
) -> Any:  # fmt: skip
    """K, ∂K/∂q and ∂K/∂v of the convex form, and what :func:`convex_units` returns.

    Wa, Wc (units, width) and Wb (units nv, width) are transposed.
    """
    nq, nv, units, width = len(q), len(v), len(ba), widths[-1]
    features, slopes = np.empty(3 * nq), np.empty((len(widths), widths.max()))
    a, c, b = _units(q, weights, widths, shift, scale, turns, Wa, ba, Wb, bb, Wc, bc, features, slopes)
    K_v, parts = np.empty(nv), np.empty((units, 3))
    K = _of_velocity(v, a, c, b, v_scale, cone_a, cone_b, cone_c, bowl_a, bowl_b, bowl_c, K_v, parts)
    g = np.zeros(width)
    for u in range(units):
        da, dz, dc = parts[u, 0] * _sigmoid(a[u]), parts[u, 1], parts[u, 2]
        for k in range(width):
            g[k] += da * Wa[u, k] + dc * Wc[u, k]
        for j in range(nv):
            weight = dz * v[j] * v_scale[j]
            for k in range(width):
                g[k] += weight * Wb[u * nv + j, k]
    g, K_q = _pull_back(g, weights, widths, slopes), np.empty(nq)
    for i in range(nq):
        cos, sin = features[nq + i], features[2 * nq + i]
        K_q[i] = g[i] * scale[i] + turns[i] * (cos * g[2 * nq + i] - sin * g[nq + i])
    return K, K_q, K_v, (a, c, b)


@kernel
def convex_units(
    q: Any, weights: Any, widths: Any, shift: Any, scale: Any, turns: Any, Wa: Any, ba: Any, Wb: Any, bb: Any,
    Wc: Any, bc: Any,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """What the convex form's units are at q: a before its softplus and c (units,), b (units, nv)."""
    features, slopes = np.empty(3 * len(q)), np.empty((len(widths), widths.max()))
    return _units(q, weights, widths, shift, scale, turns, Wa, ba, Wb, bb, Wc, bc, features, slopes)


@kernel
def rise(
    v: Any, u: Any, M: Any, Minv: Any, b: Any, dt: float, energy: float, a: Any, c: Any, units_b: Any,
    v_scale: Any, cone_a: Any, cone_b: Any, cone_c: Any, bowl_a: Any, bowl_b: Any, bowl_c: Any,
) -> tuple[float, Any, float, Any]:  # fmt: skip
    """The convex form, with its share of the kinetic energy, at v and at the v⁺ that torque u leads to in ``dt``.

    Args:
        v, u: (nv,).
        M, Minv, b: of the state.
        dt: [s].
        energy: weight of the kinetic energy.
        a, c, units_b: of :func:`convex_units`; parameters of the form follow.

    Returns:
        ``(K(v⁺) - K(v)) / dt - ∂K/∂v · v̇``; ``turn = ∂K/∂v(v⁺) - ∂K/∂v(v)`` (nv,); what the plane that touches K at v⁺
        takes off L_f phi, ``(K(v⁺) - K(v)) / dt - ∂K/∂v(v⁺) · v̇ - turnᵀ M⁻¹ b``; and off L_g phi, ``turnᵀ M⁻¹`` (nv,).
    """
    nv = len(v)
    end, K_v, K_end_v, parts = np.empty(nv), np.empty(nv), np.empty(nv), np.empty((len(a), 3))
    for i in range(nv):
        end[i] = v[i]
        for j in range(nv):
            end[i] += dt * Minv[i, j] * (u[j] - b[j])
    K = _of_velocity(v, a, c, units_b, v_scale, cone_a, cone_b, cone_c, bowl_a, bowl_b, bowl_c, K_v, parts)
    K_end = _of_velocity(end, a, c, units_b, v_scale, cone_a, cone_b, cone_c, bowl_a, bowl_b, bowl_c, K_end_v, parts)
    by_energy, along, along_end = 0.0, 0.0, 0.0
    for i in range(nv):
        momentum = change = 0.0
        for j in range(nv):
            momentum += M[i, j] * v[j]
            change += M[i, j] * (end[j] - v[j])
        by_energy += (momentum + 0.5 * change) * (end[i] - v[i])
        K_v[i] += energy * momentum
        K_end_v[i] += energy * (momentum + change)
        along += K_v[i] * (end[i] - v[i]) / dt
        along_end += K_end_v[i] * (end[i] - v[i]) / dt
    rate = (K_end - K + energy * by_energy) / dt
    turn, steering, drift = K_end_v - K_v, np.zeros(nv), rate - along_end
    for i in range(nv):
        for j in range(nv):
            steering[j] += turn[i] * Minv[i, j]
            drift -= turn[i] * Minv[i, j] * b[j]
    return rate - along, turn, drift, steering
