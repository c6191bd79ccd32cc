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
def convex(
    q: Any, v: Any, weights: Any, widths: Any, shift: Any, scale: Any, turns: Any, v_scale: Any,
    Wa: Any, ba: Any, Wb: Any, bb: Any, Wc: Any, bc: Any,
    cone_a: Any, cone_b: Any, cone_c: Any, bowl_a: Any, bowl_b: Any, bowl_c: Any,
) -> Any:  # fmt: skip
    """K, ∂K/∂q and ∂K/∂v of the convex form; Wa, Wc (units, width), Wb (units nv, width) are transposed."""
    nq, nv, units, width = len(q), len(v), len(ba), widths[-1]
    slopes = np.empty((len(widths), widths.max()))
    features = np.empty(3 * nq)
    for i in range(nq):
        angle = q[i] * turns[i]
        features[i] = (q[i] - shift[i]) * scale[i]
        features[nq + i], features[2 * nq + i] = math.cos(angle), math.sin(angle)
    x = _hidden(features, weights, widths, slopes)
    s, round_ = v * v_scale, _softplus(cone_c.item())
    K_v, g = np.empty(nv), np.zeros(width)
    root, bowl = round_**2, -bowl_c.item()
    for j in range(nv):
        root += (cone_b[j] * s[j]) ** 2
        bowl += (bowl_b[j] * s[j]) ** 2
    root, along_cone, along_bowl = math.sqrt(root), _softplus(cone_a.item()), _softplus(bowl_a.item())
    K = along_cone * (root - round_) + along_bowl * (_softplus(bowl) - _softplus(-bowl_c.item()))
    for j in range(nv):
        slope = along_cone / root * cone_b[j] ** 2 + 2.0 * along_bowl * _sigmoid(bowl) * bowl_b[j] ** 2
        K_v[j] = slope * s[j] * v_scale[j]
    for u in range(units):
        ra, c = ba[u], bc[u]
        for k in range(width):
            ra += Wa[u, k] * x[k]
            c += Wc[u, k] * x[k]
        z = 0.0
        b = np.empty(nv)
        for j in range(nv):
            b[j] = bb[u * nv + j]
            for k in range(width):
                b[j] += Wb[u * nv + j, k] * x[k]
            z += b[j] * s[j]
        a, sig, sig0 = _softplus(ra), _sigmoid(z + c), _sigmoid(c)
        D = _softplus(z + c) - _softplus(c) - sig0 * z
        K += a * D
        dz = a * (sig - sig0)
        dc = dz - a * sig0 * (1.0 - sig0) * z
        da = D * _sigmoid(ra)
        for k in range(width):
            g[k] += da * Wa[u, k] + dc * Wc[u, k]
        for j in range(nv):
            K_v[j] += dz * b[j] * v_scale[j]
            weight = dz * s[j]
            for k in range(width):
                g[k] += weight * Wb[u * nv + j, k]
    g, K_q = _pull_back(g, weights, widths, slopes), np.empty(nq)
    for i in range(nq):
        cos, sin = features[nq + i], features[2 * nq + i]
        K_q[i] = g[i] * scale[i] + turns[i] * (cos * g[2 * nq + i] - sin * g[nq + i])
    return K, K_q, K_v
