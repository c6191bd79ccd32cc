"""Affine forms: enclosures of a quantity on a box of states that keep its linear dependence on the state.

A form is an array (S + 2,): ``x(e) = x[0] + Σ_i x[1 + i] e_i ± x[S + 1]`` for every ``e`` in [-1, 1]^S, where e_i is
coordinate i of the state, scaled to the box. Linear operations are exact; others leave a remainder that shrinks with
the square of the box (Stolfi & de Figueiredo, *Self-validated numerical methods and applications*, 1997, without new
symbols: what is not linear goes into the remainder).

Rounding: every operation adds to the remainder at least ``ROUNDING`` times the size of what it computed, more than the
few half-ulps that its float64 operations can lose. Of exp, tanh, sin, cos and log1p it is assumed that they err by less
than 8 ulp of their result (glibc documents at most 2). A form whose remainder is not finite says nothing.

``out`` may be one of the inputs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ppcbf_robots.kernels import exact_kernel

ROUNDING = 4e-15  # 36 half-ulps, of the size of a result
UP = 1.0 + 1e-14  # factor that rounds a sum of a few positive terms up
TINY = 1e-300  # what underflow could lose
SIGMOID_CURVATURE = 0.0963  # largest |σ''|
SIGMOID_JERK = 0.1251  # largest |σ'''|


@exact_kernel
def radius(a: Any) -> float:
    """How far a form reaches from its centre."""
    total = a[-1]
    for i in range(1, len(a) - 1):
        total += abs(a[i])
    return float(total * UP + TINY)


@exact_kernel
def low(a: Any) -> float:
    """A lower bound."""
    r = radius(a)
    return float(a[0] - r - ROUNDING * (abs(a[0]) + r))


@exact_kernel
def high(a: Any) -> float:
    """An upper bound."""
    r = radius(a)
    return float(a[0] + r + ROUNDING * (abs(a[0]) + r))


@exact_kernel
def constant(value: float, out: Any) -> None:
    """A number that float64 holds."""
    out[:] = 0.0
    out[0] = value


@exact_kernel
def unknown(out: Any) -> None:
    """Anything at all."""
    out[:] = 0.0
    out[-1] = np.inf


@exact_kernel
def add(a: Any, b: Any, sign: float, out: Any) -> None:
    """``a + sign b``, sign being 1 or -1."""
    size, n = 0.0, len(a) - 1
    for i in range(n):
        out[i] = a[i] + sign * b[i]
        size += abs(out[i])
    out[n] = (a[n] + b[n] + ROUNDING * size) * UP + TINY


@exact_kernel
def scaled(a: Any, factor: float, out: Any) -> None:
    """``factor a``."""
    size, n = 0.0, len(a) - 1
    for i in range(n):
        out[i] = factor * a[i]
        size += abs(out[i])
    out[n] = (abs(factor) * a[n] + ROUNDING * size) * UP + TINY


@exact_kernel
def shifted(a: Any, offset: float, out: Any) -> None:
    """``a + offset``."""
    n = len(a) - 1
    r = a[n] + ROUNDING * (abs(a[0]) + abs(offset))
    for i in range(n):
        out[i] = a[i]
    out[0] = a[0] + offset
    out[n] = r * UP + TINY


@exact_kernel
def mul(a: Any, b: Any, out: Any) -> None:
    """``a b``. Of the quadratic terms, e_i² is in [0, 1] and e_i e_j in [-1, 1]."""
    n = len(a) - 1
    a0, b0, ra, rb = a[0], b[0], a[n], b[n]
    sa = sb = middle = spread = 0.0
    for i in range(1, n):
        sa += abs(a[i])
        sb += abs(b[i])
        square = 0.5 * a[i] * b[i]
        middle += square
        spread += abs(square)
        for j in range(i + 1, n):
            spread += abs(a[i] * b[j] + a[j] * b[i])
    out[0] = a0 * b0 + middle
    for i in range(1, n):
        out[i] = a0 * b[i] + b0 * a[i]
    size = (abs(a0) + sa + ra) * (abs(b0) + sb + rb)
    out[n] = (spread + (abs(a0) + sa) * rb + (abs(b0) + sb) * ra + ra * rb + ROUNDING * size) * UP + TINY


@exact_kernel
def taylor(a: Any, f0: float, f1: float, f2_low: float, f2_high: float, out: Any) -> None:
    """``f(a)`` from ``f`` and ``f'`` at a's centre, and bounds of ``f''`` over a's range, each within a few ulp."""
    n, r = len(a) - 1, radius(a)
    upper, lower = max(f2_high, 0.0), min(f2_low, 0.0)
    quarter = 0.25 * r * r
    rest = a[n]
    for i in range(1, n):
        out[i] = f1 * a[i]
    out[0] = f0 + quarter * (upper + lower)
    size = 1.0 + abs(f0) + (1.0 + abs(f1)) * r + quarter * (upper - lower)
    out[n] = (abs(f1) * rest + quarter * (upper - lower) * UP + ROUNDING * size) * UP + TINY


@exact_kernel
def inverse(a: Any, out: Any) -> None:
    """``1 / a``; unknown where a may be zero."""
    x, lo, hi = a[0], low(a), high(a)
    if lo > 0.0 or hi < 0.0:
        ends = (2.0 / (lo * lo * lo), 2.0 / (hi * hi * hi))
        f2_low, f2_high = min(ends), max(ends)
        size = max(abs(f2_low), abs(f2_high)) * 1e-13
        taylor(a, 1.0 / x, -1.0 / (x * x), f2_low - size, f2_high + size, out)
    else:
        unknown(out)


@exact_kernel
def divided(a: Any, b: Any, out: Any) -> None:
    """``a / b``."""
    reciprocal = np.empty(len(b))
    inverse(b, reciprocal)
    mul(a, reciprocal, out)


@exact_kernel
def sqrt(a: Any, out: Any) -> None:
    """Square root; unknown where a may be zero or less."""
    x, lo = a[0], low(a)
    if lo > 0.0:
        root, least = math.sqrt(x), math.sqrt(lo)
        taylor(a, root, 0.5 / root, -0.25 / (lo * least) * (1.0 + 1e-13), 0.0, out)
    else:
        unknown(out)


@exact_kernel
def root_above(a: Any, least: float, out: Any, reciprocal: Any) -> None:
    """``sqrt(a)`` and ``1 / sqrt(a)`` of a quantity known to be at least ``least > 0``, whatever its form allows."""
    lo, x = max(low(a), least), max(a[0], least)
    root = math.sqrt(x)
    slack = abs(x - a[0])  # the form is moved there, where the root exists
    moved = a.copy()
    moved[0] = x
    moved[-1] = (a[-1] + slack) * UP
    taylor(moved, root, 0.5 / root, -0.25 / (lo * math.sqrt(lo)) * (1.0 + 1e-13), 0.0, out)
    taylor(moved, 1.0 / root, -0.5 / (x * root), 0.0, 0.75 / (lo * lo * math.sqrt(lo)) * (1.0 + 1e-13), reciprocal)


@exact_kernel
def sin(a: Any, out: Any) -> None:
    """Sine."""
    s, r = math.sin(a[0]), radius(a)
    taylor(a, s, math.cos(a[0]), max(-1.0, -s - r), min(1.0, -s + r), out)


@exact_kernel
def cos(a: Any, out: Any) -> None:
    """Cosine."""
    c, r = math.cos(a[0]), radius(a)
    taylor(a, c, -math.sin(a[0]), max(-1.0, -c - r), min(1.0, -c + r), out)


@exact_kernel
def elu(a: Any, out: Any) -> None:
    """``a`` above zero, ``exp(a) - 1`` below."""
    lo, hi = low(a), high(a)
    if lo >= 0.0:
        out[:] = a
    else:
        slope = math.exp(min(a[0], 0.0))
        f0 = a[0] if a[0] > 0.0 else slope - 1.0
        least = 0.0 if hi > 0.0 else math.exp(lo) * 0.999999
        taylor(a, f0, slope, least, math.exp(min(hi, 0.0)) * 1.000001, out)


@exact_kernel
def elu_slope(a: Any, out: Any) -> None:
    """The derivative of ELU: 1 above zero, ``exp(a)`` below; at zero it has a kink."""
    lo, hi = low(a), high(a)
    if lo >= 0.0:
        constant(1.0, out)
    elif hi <= 0.0:
        f = math.exp(a[0])
        taylor(a, f, f, 0.0, math.exp(hi) * 1.000001, out)
    elif not (hi - lo < 1e3):
        unknown(out)
    else:  # between the lines of slope s, the chord's, through the kink and at the tangent point of exp
        s = (1.0 - math.exp(lo)) / (hi - lo)
        end = math.exp(lo) - s * lo
        tangent = s - s * math.log(s) if s > 0.0 and lo < math.log(s) else end
        bottom, top = min(tangent, end, 1.0 - s * hi), max(1.0, end)
        n, x, r = len(a) - 1, a[0], a[-1]
        for i in range(1, n):
            out[i] = s * a[i]
        out[0] = s * x + 0.5 * (top + bottom)
        out[n] = (s * r + 0.5 * (top - bottom) + ROUNDING * (2.0 + s * (hi - lo) + abs(s * x))) * UP + TINY


@exact_kernel
def softplus(a: Any, out: Any) -> None:
    """``log(1 + exp a)``."""
    x, r = a[0], radius(a)
    s = 0.5 * (1.0 + math.tanh(0.5 * x))
    f2 = s * (1.0 - s)
    f0 = math.log1p(math.exp(-abs(x))) + max(x, 0.0)
    taylor(a, f0, s, max(0.0, f2 - SIGMOID_CURVATURE * r), min(0.25, f2 + SIGMOID_CURVATURE * r) + ROUNDING, out)


@exact_kernel
def sigmoid(a: Any, out: Any) -> None:
    """``1 / (1 + exp -a)``."""
    r = radius(a)
    s = 0.5 * (1.0 + math.tanh(0.5 * a[0]))
    f1 = s * (1.0 - s)
    f2 = f1 * (1.0 - 2.0 * s)
    reach = SIGMOID_JERK * r + ROUNDING
    taylor(a, s, f1, max(-SIGMOID_CURVATURE, f2 - reach), min(SIGMOID_CURVATURE, f2 + reach), out)
