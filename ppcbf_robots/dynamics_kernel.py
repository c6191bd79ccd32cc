"""Rigid-body dynamics of many states at once, compiled: what Pinocchio computes for one.

Everything is in the base frame about its origin; spatial vectors are (linear, angular). A ``tree`` is the tuple
(parents, kinds, idx_q, places, axes, gravity): the joint each joint hangs on (-1: the base), TURNS to WRAPS, its first
coordinate, its placement (3, 4) at rest and unit axis (3,) in its own frame, and gravity (3,) [m/s²]. ``bodies``
(B, n, 13) holds each link's mass [kg], centre of mass (3,) [m] and inertia about it (9,) [kg m²] in its joint's frame.
Algorithms: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008 (recursive Newton-Euler, composite bodies).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ppcbf_robots.kernels import kernel

TURNS, SLIDES, WRAPS = range(3)  # revolute, prismatic, revolute stored as (cos, sin)


@kernel
def scratch(n: int) -> Any:
    """Working memory for one state of n joints: velocity, acceleration, force, mass moments, inertia, placements."""
    T = np.zeros((n + 1, 4, 4))
    T[:, 3, 3] = 1.0
    T[0, 0, 0] = T[0, 1, 1] = T[0, 2, 2] = 1.0
    six = np.zeros((3, n + 1, 6))
    return six[0], six[1], six[2], np.zeros((n, 4)), np.zeros((n, 3, 3)), T, np.zeros((6, n)), np.zeros((6, n))


@kernel
def _kinematics(q: Any, v: Any, tree: Any, V: Any, T: Any, J: Any, dJ: Any) -> None:
    """Fill placements T (n + 1, 4, 4), Jacobian J and its rate dJ (6, n), and each body's velocity V (n + 1, 6)."""
    parents, kinds, idx_q, places, axes, _ = tree
    A = np.empty((3, 4))
    for i in range(len(v)):
        P, here, F = T[parents[i] + 1], T[i + 1], places[i]
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        for r in range(3):
            for k in range(4):
                A[r, k] = P[r, 0] * F[0, k] + P[r, 1] * F[1, k] + P[r, 2] * F[2, k]
            A[r, 3] += P[r, 3]
        ax = A[0, 0] * x + A[0, 1] * y + A[0, 2] * z
        ay = A[1, 0] * x + A[1, 1] * y + A[1, 2] * z
        az = A[2, 0] * x + A[2, 1] * y + A[2, 2] * z
        at = idx_q[i]
        if kinds[i] == SLIDES:
            here[:3] = A
            here[0, 3] += ax * q[at]
            here[1, 3] += ay * q[at]
            here[2, 3] += az * q[at]
            J[0, i], J[1, i], J[2, i], J[3, i], J[4, i], J[5, i] = ax, ay, az, 0.0, 0.0, 0.0
        else:
            c, s = (q[at], q[at + 1]) if kinds[i] == WRAPS else (math.cos(q[at]), math.sin(q[at]))
            e = 1.0 - c
            for r in range(3):
                a0, a1, a2 = A[r, 0], A[r, 1], A[r, 2]
                here[r, 0] = a0 * (c + e * x * x) + a1 * (e * x * y + s * z) + a2 * (e * x * z - s * y)
                here[r, 1] = a0 * (e * x * y - s * z) + a1 * (c + e * y * y) + a2 * (e * y * z + s * x)
                here[r, 2] = a0 * (e * x * z + s * y) + a1 * (e * y * z - s * x) + a2 * (c + e * z * z)
                here[r, 3] = A[r, 3]
            px, py, pz = A[0, 3], A[1, 3], A[2, 3]
            J[0, i], J[1, i], J[2, i] = py * az - pz * ay, pz * ax - px * az, px * ay - py * ax
            J[3, i], J[4, i], J[5, i] = ax, ay, az
        for r in range(6):
            V[i + 1, r] = V[parents[i] + 1, r] + J[r, i] * v[i]
        _cross(V[i + 1], J[:, i], dJ[:, i])


@kernel
def _cross(V: Any, M: Any, out: Any) -> None:
    """Rate of a motion vector M (6,) that is carried along with velocity V (6,)."""
    out[0] = V[4] * M[2] - V[5] * M[1] + V[1] * M[5] - V[2] * M[4]
    out[1] = V[5] * M[0] - V[3] * M[2] + V[2] * M[3] - V[0] * M[5]
    out[2] = V[3] * M[1] - V[4] * M[0] + V[0] * M[4] - V[1] * M[3]
    out[3] = V[4] * M[5] - V[5] * M[4]
    out[4] = V[5] * M[3] - V[3] * M[5]
    out[5] = V[3] * M[4] - V[4] * M[3]


@kernel
def _momentum(m: Any, I: Any, V: Any, out: Any) -> None:
    """Inertia times a motion vector (6,); m (4,) holds mass and mass times centre, I (3, 3) is about the origin."""
    out[0] = m[0] * V[0] + V[4] * m[3] - V[5] * m[2]
    out[1] = m[0] * V[1] + V[5] * m[1] - V[3] * m[3]
    out[2] = m[0] * V[2] + V[3] * m[2] - V[4] * m[1]
    out[3] = m[2] * V[2] - m[3] * V[1] + I[0, 0] * V[3] + I[0, 1] * V[4] + I[0, 2] * V[5]
    out[4] = m[3] * V[0] - m[1] * V[2] + I[1, 0] * V[3] + I[1, 1] * V[4] + I[1, 2] * V[5]
    out[5] = m[1] * V[1] - m[2] * V[0] + I[2, 0] * V[3] + I[2, 1] * V[4] + I[2, 2] * V[5]


@kernel
def _place_inertia(T: Any, body: Any, m: Any, I: Any) -> None:
    """A link's mass moments m (4,) and inertia I (3, 3) about the base's origin."""
    c = np.empty(3)
    for r in range(3):
        c[r] = T[r, 0] * body[1] + T[r, 1] * body[2] + T[r, 2] * body[3] + T[r, 3]
        m[1 + r] = body[0] * c[r]
    m[0] = body[0]
    square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
    for r in range(3):
        x = T[r, 0] * body[4] + T[r, 1] * body[7] + T[r, 2] * body[10]
        y = T[r, 0] * body[5] + T[r, 1] * body[8] + T[r, 2] * body[11]
        z = T[r, 0] * body[6] + T[r, 1] * body[9] + T[r, 2] * body[12]
        for k in range(3):
            I[r, k] = x * T[k, 0] + y * T[k, 1] + z * T[k, 2] - body[0] * c[r] * c[k]
        I[r, r] += body[0] * square


@kernel
def _dynamics(q: Any, v: Any, tree: Any, bodies: Any, work: Any, M: Any, b: Any, g: Any) -> None:
    """Mass matrix M (n, n), bias torque b (n,) and gravity torque g (n,) of one state; kinematics stay in ``work``."""
    V, A, F, m, I, T, J, dJ = work
    parents, gravity, n = tree[0], tree[5], len(v)
    _kinematics(q, v, tree, V, T, J, dJ)
    A[0, 0], A[0, 1], A[0, 2] = -gravity[0], -gravity[1], -gravity[2]
    h = np.empty(6)
    for i in range(n):
        for r in range(6):
            A[i + 1, r] = A[parents[i] + 1, r] + dJ[r, i] * v[i]
        _place_inertia(T[i + 1], bodies[i], m[i], I[i])
        _momentum(m[i], I[i], A[i + 1], F[i + 1])
        _momentum(m[i], I[i], V[i + 1], h)
        W, f = V[i + 1], F[i + 1]
        f[0] += W[4] * h[2] - W[5] * h[1]
        f[1] += W[5] * h[0] - W[3] * h[2]
        f[2] += W[3] * h[1] - W[4] * h[0]
        f[3] += W[4] * h[5] - W[5] * h[4] + W[1] * h[2] - W[2] * h[1]
        f[4] += W[5] * h[3] - W[3] * h[5] + W[2] * h[0] - W[0] * h[2]
        f[5] += W[3] * h[4] - W[4] * h[3] + W[0] * h[1] - W[1] * h[0]
    for i in range(n - 1, -1, -1):  # F, m and I of joint i are now those of all that it carries
        b[i] = 0.0
        for r in range(6):
            b[i] += J[r, i] * F[i + 1, r]
        x, y, z = m[i, 1], m[i, 2], m[i, 3]
        g[i] = -m[i, 0] * (J[0, i] * gravity[0] + J[1, i] * gravity[1] + J[2, i] * gravity[2])
        g[i] -= J[3, i] * (y * gravity[2] - z * gravity[1]) + J[4, i] * (z * gravity[0] - x * gravity[2])
        g[i] -= J[5, i] * (x * gravity[1] - y * gravity[0])
        _momentum(m[i], I[i], J[:, i], h)
        for j in range(n):
            M[i, j] = 0.0 if j < i else M[i, j]
        j = i
        while j >= 0:
            M[i, j] = M[j, i] = (
                J[0, j] * h[0] + J[1, j] * h[1] + J[2, j] * h[2] + J[3, j] * h[3] + J[4, j] * h[4] + J[5, j] * h[5]
            )
            j = parents[j]
        p = parents[i]
        if p >= 0:
            for r in range(6):
                F[p + 1, r] += F[i + 1, r]
            for r in range(4):
                m[p, r] += m[i, r]
            for r in range(3):
                for k in range(3):
                    I[p, r, k] += I[i, r, k]


@kernel
def _factor(M: Any, L: Any) -> None:
    """Cholesky factor L (n, n), lower, of M; NaN where M is not positive definite."""
    for i in range(len(M)):
        for j in range(i + 1):
            total = M[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(total) if i == j else total / L[j, j]


@kernel
def _solve(L: Any, x: Any) -> None:
    """x (n,) becomes M⁻¹ x."""
    n = len(x)
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]


@kernel
def terms_at(
    q: Any, v: Any, tree: Any, bodies: Any, T: Any, J: Any, dJ: Any, M: Any, Minv: Any, b: Any, g: Any
) -> None:
    """Terms of :class:`ppcbf_robots.robot.Dynamics` (b for Cv) of a batch; all but ``tree`` have a leading axis B."""
    n = v.shape[1]
    work, L = scratch(n), np.zeros((n, n))
    for s in range(len(v)):
        _dynamics(q[s], v[s], tree, bodies[s], work, M[s], b[s], g[s])
        T[s], J[s], dJ[s] = work[5], work[6], work[7]
        _factor(M[s], L)
        for i in range(n):
            Minv[s, i] = 0.0
            Minv[s, i, i] = 1.0
            _solve(L, Minv[s, i])


@kernel
def _shift(q: Any, kinds: Any, idx_q: Any, step: float, v: Any, out: Any) -> None:
    """The configuration after moving at v (n,) for ``step``."""
    for i in range(len(v)):
        at, d = idx_q[i], step * v[i]
        if kinds[i] == WRAPS:
            c, s = math.cos(d), math.sin(d)
            x, y = q[at] * c - q[at + 1] * s, q[at] * s + q[at + 1] * c
            scale = 0.5 * (3.0 - x * x - y * y)  # back to length 1
            out[at], out[at + 1] = scale * x, scale * y
        else:
            out[at] = q[at] + d


@kernel
def advance(q: Any, v: Any, u: Any, dt: float, count: int, tree: Any, bodies: Any) -> None:
    """``count`` Runge-Kutta steps of ``dt`` [s] under the torque u, held; q (B, nq) and v (B, n) are moved on."""
    n, kinds, idx_q = v.shape[1], tree[1], tree[2]
    work, L, M = scratch(n), np.zeros((n, n)), np.zeros((n, n))
    b, g, a, w, at = np.empty(n), np.empty(n), np.empty((4, n)), np.empty((4, n)), np.empty(q.shape[1])
    lead = (0.0, 0.5 * dt, 0.5 * dt, dt)
    for s in range(len(v)):
        for _ in range(count):
            for k in range(4):  # w: velocities, a: accelerations at the four stages
                for i in range(n):
                    w[k, i] = v[s, i] + (lead[k] * a[k - 1, i] if k > 0 else 0.0)
                _shift(q[s], kinds, idx_q, lead[k], w[k - 1] if k > 0 else v[s], at)
                _dynamics(at, w[k], tree, bodies[s], work, M, b, g)
                _factor(M, L)
                for i in range(n):
                    a[k, i] = u[s, i] - b[i]
                _solve(L, a[k])
            for i in range(n):
                w[0, i] = (w[0, i] + 2.0 * w[1, i] + 2.0 * w[2, i] + w[3, i]) / 6.0
                v[s, i] += dt * (a[0, i] + 2.0 * a[1, i] + 2.0 * a[2, i] + a[3, i]) / 6.0
            _shift(q[s], kinds, idx_q, dt, w[0], at)
            q[s] = at
