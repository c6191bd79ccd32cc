"""Compiled geometry: signed distances of body spheres to obstacles, with first and second order terms, in one pass.

Every obstacle is given in a frame of its own, where ``core`` returns the distance of a point, its gradient and the
second order term along a velocity. All shapes are C² where a body sphere can be, and never above the true distance:

* A sphere and a half-space are exact.
* A box, capsule or cylinder is the Euclidean norm of smoothed overshoots ``s(x)`` beyond a core that lies ``rho``
  inside its faces. ``s`` is 0 up to the core, then ``rho (t³ - t⁴/2)`` with ``t = x / rho``, then ``x - rho / 2``: C²
  and convex. At a flat face ``s = rho / 2``; ``sqrt(k) rho / 2`` is subtracted where k overshoots meet, so the rounded
  corner contains the sharp one.
* A convex mesh is the log-sum-exp of its supporting planes, shifted by ``log(m) / kappa`` below their largest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])
Vector = tuple[float, float, float]
Core = tuple[float, float, float, float, float]  # distance, second order term, gradient

SPHERE, HALF_SPACE, BOX, CAPSULE, CYLINDER, MESH = range(6)
FAST_MATH = {"reassoc", "contract"}  # lets sums be vectorised; NaN and infinity keep their meaning
_TINY = 1e-9  # [m], below which the direction away from a centre is not defined
_NEGLIGIBLE = -40.0  # exponent of a plane's weight below which it does not count
THREADS: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # the cores, or what the environment says


def kernel(function: F) -> F:
    """Compile with numba, to run beside other threads; cached beside the source, or in the user's cache folder."""
    return cast(F, numba.njit(cache=True, error_model="numpy", fastmath=FAST_MATH, nogil=True)(function))


def inlined(function: F) -> F:
    """The same, copied into its callers: a call with a few arrays costs as much as the distance to a box."""
    return cast(F, numba.njit(cache=True, error_model="numpy", fastmath=FAST_MATH, inline="always")(function))


def exact_kernel(function: F) -> F:
    """The same with IEEE arithmetic as written, for bounds that count rounding errors."""
    return cast(F, numba.njit(cache=True, error_model="numpy", nogil=True)(function))


@inlined
def _ramp(x: float, rho: float) -> tuple[float, float, float]:
    """Smoothed ``max(x, 0)`` and its first two derivatives."""
    if x <= 0.0:
        return 0.0, 0.0, 0.0
    if x >= rho:
        return x - 0.5 * rho, 1.0, 0.0
    t = x / rho
    return rho * t * t * t * (1.0 - 0.5 * t), t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / rho


@inlined
def _box(x: Vector, w: Vector, size: Any) -> Core:
    """size: half edges and rho. Norm of three overshoots."""
    rho = size[3]
    sx, sx1, sx2 = _ramp(abs(x[0]) - size[0] + rho, rho)
    sy, sy1, sy2 = _ramp(abs(x[1]) - size[1] + rho, rho)
    sz, sz1, sz2 = _ramp(abs(x[2]) - size[2] + rho, rho)
    d = max(math.sqrt(sx * sx + sy * sy + sz * sz), _TINY)
    n0, n1 = math.copysign(sx * sx1, x[0]) / d, math.copysign(sy * sy1, x[1]) / d
    n2 = math.copysign(sz * sz1, x[2]) / d
    second = (
        (sx1 * sx1 + sx * sx2) * w[0] ** 2 + (sy1 * sy1 + sy * sy2) * w[1] ** 2 + (sz1 * sz1 + sz * sz2) * w[2] ** 2
    )
    along = n0 * w[0] + n1 * w[1] + n2 * w[2]
    return d - 0.5 * math.sqrt(3.0) * rho, (second - along * along) / d, n0, n1, n2


@inlined
def _capsule(x: Vector, w: Vector, size: Any) -> Core:
    """size: radius, half length of the segment along z, rho."""
    s, s1, s2 = _ramp(abs(x[2]) - size[1], size[2])
    d = max(math.sqrt(x[0] * x[0] + x[1] * x[1] + s * s), _TINY)
    n0, n1, n2 = x[0] / d, x[1] / d, math.copysign(s * s1, x[2]) / d
    along = n0 * w[0] + n1 * w[1] + n2 * w[2]
    second = w[0] * w[0] + w[1] * w[1] + (s1 * s1 + s * s2) * w[2] * w[2]
    return d - size[0], (second - along * along) / d, n0, n1, n2


@inlined
def _cylinder(x: Vector, w: Vector, size: Any) -> Core:
    """size: radius, half length along z, rho. Norm of the radial and the axial overshoot."""
    rho = size[2]
    r = max(math.sqrt(x[0] * x[0] + x[1] * x[1]), _TINY)
    s, s1, s2 = _ramp(r - size[0] + rho, rho)
    z, z1, z2 = _ramp(abs(x[2]) - size[1] + rho, rho)
    d = max(math.sqrt(s * s + z * z), _TINY)
    n_r, n_z = s * s1 / d, math.copysign(z * z1, x[2]) / d
    w_r = (x[0] * w[0] + x[1] * w[1]) / r
    around = max(w[0] * w[0] + w[1] * w[1] - w_r * w_r, 0.0)
    along = n_r * w_r + n_z * w[2]
    second = (s1 * s1 + s * s2) * w_r * w_r + (z1 * z1 + z * z2) * w[2] * w[2]
    second = (second - along * along) / d + n_r / r * around
    return d - 0.5 * math.sqrt(2.0) * rho, second, n_r * x[0] / r, n_r * x[1] / r, n_z


@kernel
def _mesh(x: Vector, w: Vector, kappa: float, planes: Any, first: int, end: int) -> Core:
    """planes (:, 4): outward unit normal and offset. Smooth maximum, shifted below the largest plane distance."""
    largest = -1e300
    for k in range(first, end):
        largest = max(largest, planes[k, 0] * x[0] + planes[k, 1] * x[1] + planes[k, 2] * x[2] - planes[k, 3])
    total = along = square = n0 = n1 = n2 = 0.0
    for k in range(first, end):
        a0, a1, a2 = planes[k, 0], planes[k, 1], planes[k, 2]
        exponent = kappa * (a0 * x[0] + a1 * x[1] + a2 * x[2] - planes[k, 3] - largest)
        if exponent > _NEGLIGIBLE:
            weight = math.exp(exponent)
            speed = a0 * w[0] + a1 * w[1] + a2 * w[2]
            total += weight
            along += weight * speed
            square += weight * speed * speed
            n0, n1, n2 = n0 + weight * a0, n1 + weight * a1, n2 + weight * a2
    along /= total
    d = largest + (math.log(total) - math.log(end - first)) / kappa
    return d, kappa * (square / total - along * along), n0 / total, n1 / total, n2 / total


@inlined
def core(kind: int, x: Vector, w: Vector, size: Any, planes: Any, first: int, end: int) -> Core:
    """Distance [m] of a point to an obstacle, second order term ``wᵀ H w`` and gradient, in the obstacle's frame.

    Args:
        kind: SPHERE to MESH.
        x: the point [m].
        w: its velocity [m/s].
        size: (4,) see each shape; sphere: radius; mesh: kappa [1/m].
        planes: supporting planes of all meshes (:, 4), of which ``first`` to ``end`` are this one's.
        first: see planes.
        end: see planes.
    """
    if kind == HALF_SPACE:
        return x[2], 0.0, 0.0, 0.0, 1.0
    if kind == BOX:
        return _box(x, w, size)
    if kind == CAPSULE:
        return _capsule(x, w, size)
    if kind == CYLINDER:
        return _cylinder(x, w, size)
    if kind == MESH:
        return _mesh(x, w, size[0], planes, first, end)
    d = max(math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), _TINY)
    n0, n1, n2 = x[0] / d, x[1] / d, x[2] / d
    along = n0 * w[0] + n1 * w[1] + n2 * w[2]
    return d - size[0], (w[0] * w[0] + w[1] * w[1] + w[2] * w[2] - along * along) / d, n0, n1, n2


@kernel
def point_kinematics(
    placements: Any, J: Any, dJ: Any, v: Any, joints: Any, offsets: Any, mask: Any, p: Any, Jp: Any, vel: Any, acc: Any
) -> None:
    """Body points at one state: p (P, 3), Jp (P, 3, nv), vel = Jp v (P, 3) and acc = J̇p v (P, 3) are filled in.

    placements (joints, 4, 4); J, dJ (6, nv) spatial in the base frame at its origin, rows (linear, angular).
    """
    nv = len(v)
    for i in range(len(joints)):
        T = placements[joints[i]]
        for r in range(3):
            p[i, r] = T[r, 0] * offsets[i, 0] + T[r, 1] * offsets[i, 1] + T[r, 2] * offsets[i, 2] + T[r, 3]
            vel[i, r] = 0.0
            acc[i, r] = 0.0
        x, y, z = p[i, 0], p[i, 1], p[i, 2]
        wx = wy = wz = 0.0
        for j in range(nv):
            if not mask[i, j]:
                Jp[i, 0, j] = Jp[i, 1, j] = Jp[i, 2, j] = 0.0
                continue
            a, b, c = J[3, j], J[4, j], J[5, j]
            Jp[i, 0, j] = J[0, j] + b * z - c * y
            Jp[i, 1, j] = J[1, j] + c * x - a * z
            Jp[i, 2, j] = J[2, j] + a * y - b * x
            wx, wy, wz = wx + a * v[j], wy + b * v[j], wz + c * v[j]
            a, b, c = dJ[3, j], dJ[4, j], dJ[5, j]
            acc[i, 0] += (dJ[0, j] + b * z - c * y) * v[j]
            acc[i, 1] += (dJ[1, j] + c * x - a * z) * v[j]
            acc[i, 2] += (dJ[2, j] + a * y - b * x) * v[j]
            for r in range(3):
                vel[i, r] += Jp[i, r, j] * v[j]
        acc[i, 0] += wy * vel[i, 2] - wz * vel[i, 1]
        acc[i, 1] += wz * vel[i, 0] - wx * vel[i, 2]
        acc[i, 2] += wx * vel[i, 1] - wy * vel[i, 0]


@kernel
def mirror(A: Any) -> None:
    """Copy the upper triangle of a square matrix to the lower one."""
    for i in range(len(A)):
        for j in range(i):
            A[i, j] = A[j, i]


@kernel
def points_at(placements: Any, J: Any, dJ: Any, v: Any, joints: Any, offsets: Any, mask: Any, p: Any, Jp: Any,
              acc: Any) -> None:  # fmt: skip
    """:func:`point_kinematics` for a batch: every state's array carries a leading axis."""
    vel = np.empty((len(joints), 3))
    for s in range(len(v)):
        point_kinematics(placements[s], J[s], dJ[s], v[s], joints, offsets, mask, p[s], Jp[s], vel, acc[s])


@inlined
def _obstacle_row(
    p: Vector, vel: Vector, acc: Vector, kind: int, size: Any, planes: Any, first: int, end: int, f: Any,
    motion: Any, moves: bool,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """h, ∂h/∂t, ḧ without ``∇h a``, and ∇h in the base frame, of one body point and one obstacle.

    f (3, 4): rotation and origin; motion (3, 3): rows are the origin's velocity and acceleration and the angular
    velocity (constant), all in the base frame; they count if the obstacle moves.
    """
    rx, ry, rz = p[0] - f[0, 3], p[1] - f[1, 3], p[2] - f[2, 3]
    sx = sy = sz = 0.0  # the obstacle's velocity at p
    ux, uy, uz = vel  # of p relative to it
    gx, gy, gz = acc  # p̈ as seen from it, without J a
    if moves:
        ox, oy, oz = motion[2, 0], motion[2, 1], motion[2, 2]
        tx, ty, tz = oy * rz - oz * ry, oz * rx - ox * rz, ox * ry - oy * rx  # ω x r
        sx, sy, sz = motion[0, 0] + tx, motion[0, 1] + ty, motion[0, 2] + tz
        ux, uy, uz = ux - sx, uy - sy, uz - sz
        # minus the origin's acceleration, minus ω x (ω x r), minus 2 ω x u
        gx -= motion[1, 0] + (oy * tz - oz * ty) + 2.0 * (oy * uz - oz * uy)
        gy -= motion[1, 1] + (oz * tx - ox * tz) + 2.0 * (oz * ux - ox * uz)
        gz -= motion[1, 2] + (ox * ty - oy * tx) + 2.0 * (ox * uy - oy * ux)
    if kind == SPHERE:  # round: no need of its frame
        d, second, n0, n1, n2 = core(kind, (rx, ry, rz), (ux, uy, uz), size, planes, first, end)
    else:
        x = (f[0, 0] * rx + f[1, 0] * ry + f[2, 0] * rz, f[0, 1] * rx + f[1, 1] * ry + f[2, 1] * rz,
             f[0, 2] * rx + f[1, 2] * ry + f[2, 2] * rz)  # fmt: skip
        w = (f[0, 0] * ux + f[1, 0] * uy + f[2, 0] * uz, f[0, 1] * ux + f[1, 1] * uy + f[2, 1] * uz,
             f[0, 2] * ux + f[1, 2] * uy + f[2, 2] * uz)  # fmt: skip
        d, second, a0, a1, a2 = core(kind, x, w, size, planes, first, end)
        n0 = f[0, 0] * a0 + f[0, 1] * a1 + f[0, 2] * a2
        n1 = f[1, 0] * a0 + f[1, 1] * a1 + f[1, 2] * a2
        n2 = f[2, 0] * a0 + f[2, 1] * a1 + f[2, 2] * a2
    return d, -(n0 * sx + n1 * sy + n2 * sz), second + n0 * gx + n1 * gy + n2 * gz, n0, n1, n2


@inlined
def _self_row(p: Any, vel: Any, acc: Any, a: int, b: int) -> tuple[float, float, float, float, float, float]:
    """Distance between points a and b, its rate, second order term, and the direction from b to a (base frame)."""
    x, y, z = p[a, 0] - p[b, 0], p[a, 1] - p[b, 1], p[a, 2] - p[b, 2]
    d = max(math.sqrt(x * x + y * y + z * z), _TINY)
    n0, n1, n2 = x / d, y / d, z / d
    wx, wy, wz = vel[a, 0] - vel[b, 0], vel[a, 1] - vel[b, 1], vel[a, 2] - vel[b, 2]
    along = n0 * wx + n1 * wy + n2 * wz
    push = n0 * (acc[a, 0] - acc[b, 0]) + n1 * (acc[a, 1] - acc[b, 1]) + n2 * (acc[a, 2] - acc[b, 2])
    return d, along, push + (wx * wx + wy * wy + wz * wz - along * along) / d, n0, n1, n2


@kernel
def _pair_rows(
    p: Any, vel: Any, acc: Any, radii: Any, P: int, kinds: Any, sizes: Any, margins: Any, planes: Any, plane_start: Any,
    frames: Any, motions: Any, moving: Any, self_pairs: Any, h: Any, drift: Any, curvature: Any, n: Any,
) -> None:  # fmt: skip
    """All rows of pairs at one state, and in n (pairs, 3) the direction of each, in the base frame.

    The first P points keep off the obstacles; the others, fixed to the base, are met by self-collision pairs alone.
    """
    O = len(kinds)
    for o in range(O):
        kind, size, frame, motion, moves = kinds[o], sizes[o], frames[o], motions[o], moving[o]
        first, end = plane_start[o], plane_start[o + 1]
        for i in range(P):
            row = i * O + o
            d, drift[row], curvature[row], n[row, 0], n[row, 1], n[row, 2] = _obstacle_row(
                (p[i, 0], p[i, 1], p[i, 2]), (vel[i, 0], vel[i, 1], vel[i, 2]), (acc[i, 0], acc[i, 1], acc[i, 2]),
                kind, size, planes, first, end, frame, motion, moves,
            )  # fmt: skip
            h[row] = d - radii[i] - margins[o]
    for k in range(len(self_pairs)):
        row, a, b = P * O + k, self_pairs[k, 0], self_pairs[k, 1]
        d, _, curvature[row], n[row, 0], n[row, 1], n[row, 2] = _self_row(p, vel, acc, a, b)
        h[row], drift[row] = d - radii[a] - radii[b], 0.0


@kernel
def _first_order(
    p: Any, vel: Any, acc: Any, radii: Any, P: int, kinds: Any, sizes: Any, margins: Any, planes: Any, plane_start: Any,
    frames: Any, motions: Any, self_pairs: Any, h: Any, hdot: Any,
) -> None:  # fmt: skip
    """h and ḣ of :func:`_pair_rows` among obstacles at rest; what is of second order is unused, so it costs nothing."""
    O = len(kinds)
    for o in range(O):
        kind, size, frame, motion = kinds[o], sizes[o], frames[o], motions[o]
        first, end = plane_start[o], plane_start[o + 1]
        for i in range(P):
            row, velocity = i * O + o, (vel[i, 0], vel[i, 1], vel[i, 2])
            d, _, _, n0, n1, n2 = _obstacle_row(
                (p[i, 0], p[i, 1], p[i, 2]), velocity, (acc[i, 0], acc[i, 1], acc[i, 2]),
                kind, size, planes, first, end, frame, motion, False,
            )  # fmt: skip
            h[row] = d - radii[i] - margins[o]
            hdot[row] = n0 * velocity[0] + n1 * velocity[1] + n2 * velocity[2]
    for k in range(len(self_pairs)):
        row, a, b = P * O + k, self_pairs[k, 0], self_pairs[k, 1]
        d, hdot[row], _, _, _, _ = _self_row(p, vel, acc, a, b)
        h[row] = d - radii[a] - radii[b]


@kernel
def _gradient(row: int, n: Any, Jp: Any, P: int, O: int, self_pairs: Any, out: Any) -> None:
    """∇h (nv,) of a pair's row."""
    pairs, nv = P * O, len(out)
    if row < pairs:
        i = row // O
        for j in range(nv):
            out[j] = n[row, 0] * Jp[i, 0, j] + n[row, 1] * Jp[i, 1, j] + n[row, 2] * Jp[i, 2, j]
        return
    a, b = self_pairs[row - pairs, 0], self_pairs[row - pairs, 1]
    for j in range(nv):
        out[j] = 0.0
        for r in range(3):
            out[j] += n[row, r] * (Jp[a, r, j] - Jp[b, r, j])


@kernel
def rows_at(
    placements: Any, J: Any, dJ: Any, v: Any, angles: Any, h: Any, grad: Any, drift: Any, curvature: Any,
    joints: Any, offsets: Any, mask: Any, radii: Any, P: int,
    kinds: Any, sizes: Any, margins: Any, planes: Any, plane_start: Any, frames: Any, motions: Any,
    self_pairs: Any, limit_joint: Any, limit_sign: Any, limit_bound: Any,
) -> None:  # fmt: skip
    """All rows at a batch of states: body points by obstacles (obstacle fastest), self-collision pairs, joint limits.

    Inputs of one state as in :func:`point_kinematics` with a leading batch axis; outputs h, drift, curvature (B, rows)
    and grad (B, rows, nv). Then follow the points of the body and of what is fixed to the base, all radii, the number P
    of the body's, obstacles as packed by :class:`ppcbf_robots.shapes.Packed`, self-collision pairs (:, 2) of any of the
    points, and joint limits.
    """
    points, O, nv = len(joints), len(kinds), v.shape[1]
    p, vel, acc = np.empty((points, 3)), np.empty((points, 3)), np.empty((points, 3))
    pairs = P * O + len(self_pairs)
    Jp, n = np.empty((points, 3, nv)), np.empty((pairs, 3))
    moving = np.array([np.any(motions[o] != 0.0) for o in range(O)])
    for s in range(len(v)):
        point_kinematics(placements[s], J[s], dJ[s], v[s], joints, offsets, mask, p, Jp, vel, acc)
        _pair_rows(p, vel, acc, radii, P, kinds, sizes, margins, planes, plane_start, frames, motions, moving,
                   self_pairs, h[s], drift[s], curvature[s], n)  # fmt: skip
        for row in range(pairs):
            _gradient(row, n, Jp, P, O, self_pairs, grad[s, row])
        for k in range(len(limit_joint)):
            row, j = pairs + k, limit_joint[k]
            h[s, row] = limit_sign[k] * (angles[s, j] - limit_bound[k])
            drift[s, row] = curvature[s, row] = 0.0
            grad[s, row, :] = 0.0
            grad[s, row, j] = limit_sign[k]


@kernel
def _insert(key: float, row: int, keys: Any, rows: Any) -> None:
    """Put a row where it belongs among those of the least keys, in ascending order; the last one leaves."""
    at = len(keys) - 1
    while at > 0 and keys[at - 1] > key:
        keys[at], rows[at] = keys[at - 1], rows[at - 1]
        at -= 1
    keys[at], rows[at] = key, row


@kernel
def nearest_rows_at(
    placements: Any, J: Any, dJ: Any, v: Any, angles: Any, gamma: float, share: Any,
    least: Any, least_rho: Any, h: Any, grad: Any, curvature: Any,
    joints: Any, offsets: Any, mask: Any, radii: Any, P: int,
    kinds: Any, sizes: Any, margins: Any, planes: Any, plane_start: Any, frames: Any, motions: Any,
    self_pairs: Any, limit_joint: Any, limit_sign: Any, limit_bound: Any,
) -> None:  # fmt: skip
    """Of :func:`rows_at`, among obstacles at rest, the rows of least ``gamma h + min(ḣ, 0)``, in that order.

    share (B,) is that of v at which ``rho = ḣ + gamma h`` is asked for. Outputs: least h and least rho (B,) of all
    rows; h, curvature (B, N) and grad (B, N, nv) of the nearest N.
    """
    points, O, nv, count = len(joints), len(kinds), v.shape[1], h.shape[1]
    p, vel, acc = np.empty((points, 3)), np.empty((points, 3)), np.empty((points, 3))
    pairs, rows = P * O + len(self_pairs), P * O + len(self_pairs) + len(limit_joint)
    Jp, n = np.empty((points, 3, nv)), np.empty((pairs, 3))
    all_h, all_hdot = np.empty(rows), np.empty(rows)
    keys, nearest = np.empty(count), np.zeros(count, dtype=np.int64)
    for s in range(len(v)):
        point_kinematics(placements[s], J[s], dJ[s], v[s], joints, offsets, mask, p, Jp, vel, acc)
        _first_order(p, vel, acc, radii, P, kinds, sizes, margins, planes, plane_start, frames, motions,
                     self_pairs, all_h, all_hdot)  # fmt: skip
        for k in range(len(limit_joint)):
            all_h[pairs + k] = limit_sign[k] * (angles[s, limit_joint[k]] - limit_bound[k])
            all_hdot[pairs + k] = limit_sign[k] * v[s, limit_joint[k]]
        keys[:] = np.inf
        least_h = rho = np.inf
        for row in range(rows):
            least_h = min(least_h, all_h[row])
            rho = min(rho, share[s] * all_hdot[row] + gamma * all_h[row])
            key = gamma * all_h[row] + min(all_hdot[row], 0.0)
            if key < keys[count - 1]:
                _insert(key, row, keys, nearest)
        least[s], least_rho[s] = least_h, rho
        for at in range(count):
            row = nearest[at]
            h[s, at], curvature[s, at] = all_h[row], 0.0
            if row >= pairs:
                grad[s, at, :] = 0.0
                grad[s, at, limit_joint[row - pairs]] = limit_sign[row - pairs]
                continue
            if row < P * O:
                i = row // O
                o = row - i * O
                _, _, curvature[s, at], n[row, 0], n[row, 1], n[row, 2] = _obstacle_row(
                    (p[i, 0], p[i, 1], p[i, 2]), (vel[i, 0], vel[i, 1], vel[i, 2]), (acc[i, 0], acc[i, 1], acc[i, 2]),
                    kinds[o], sizes[o], planes, plane_start[o], plane_start[o + 1], frames[o], motions[o], False,
                )  # fmt: skip
            else:
                a, b = self_pairs[row - P * O, 0], self_pairs[row - P * O, 1]
                _, _, curvature[s, at], n[row, 0], n[row, 1], n[row, 2] = _self_row(p, vel, acc, a, b)
            _gradient(row, n, Jp, P, O, self_pairs, grad[s, at])
