"""Largest viable set of a robot with two joints by Hamilton-Jacobi reachability on a grid.

The value ``V(q, v) = max_u min_t min_k h_k`` is the largest solution of ``min(h - V, max_u dV/dt) = 0``. The system is
affine in the torque, so with p = ∂V/∂q and s = ∂V/∂v

    max_u dV/dt = p·v + s·a_0 + Σ_i |(M⁻¹ s)_i| u_max,i,     a_0 = -M⁻¹ (C v + g).

Starting from V = h, which is above the solution, V is swept downwards: gradients by the WENO3 scheme of
hj_reachability, a local Lax-Friedrichs Hamiltonian, two-stage Runge-Kutta steps, and ``V <= h`` after each. Only the
limit matters, not the way there, so every node takes the step that its own speeds allow (four times fewer sweeps than
with one step for all).

M⁻¹, g and C v, which is quadratic in v, come from Pinocchio at the nodes; h is the least of all rows of the safety
function, joint limits included. The velocity rows of a guarded X are no part of it: the filter gives them up first.

**The edge of X is no wall.** A motion that leaves X without touching anything is safe, so the grid reaches beyond X:
braking one joint hard may drive another far beyond its range for a while. Beyond the grid's own edge what is still to
be lost, V - h, counts as at the edge; the more the grid reaches beyond X, the less that matters.

Needs the extra ``study`` (jax, hj_reachability).
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import hj_reachability as hj
import jax
import jax.numpy as jnp
import numpy as np
from hj_reachability.finite_differences.upwind_first import WENO3

from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array
from ppcbf_robots.viable_set import Nodes, ViableSet, keep, recall

VERSION = 1  # of the method: another one finds nothing in the cache
NODES = 41  # per axis
LEAST_NODES = 7
BEYOND_Q = 0.2  # of X's width, by which the grid reaches beyond X on either side
BEYOND_V = 1.0
CFL = 0.8
TOLERANCE = 1e-4  # [m], largest change of V in one sweep when it counts as settled,
NEAR = 0.2  # [m], where V is at least -NEAR: V is constant along the best motions, so what lies deeper has no say
SWEEPS = 25  # between two looks at the change
MAX_SWEEPS = 3000

GHOSTS = 2  # nodes beyond an edge that WENO3 looks at
INNER = slice(GHOSTS, -GHOSTS)

ALIKE = 1e-9

OnSweeps = Callable[[int, float], None]


class Tables(NamedTuple):
    """What the dynamics are on the grid, from Pinocchio; nodes of the two joints first."""

    h: Array  # (n1 + 4, n2 + 4) least row of the safety function, also at the GHOSTS nodes beyond each edge
    Minv: Array  # (n1, n2, 2, 2)
    a_0: Array  # (n1, n2, 2, 4): acceleration without torque, to be multiplied by 1, v1², v1 v2, v2²
    u_max: Array  # (2,)


def solve(
    problem: Problem,
    nodes: int = NODES,
    beyond_v: float = BEYOND_V,
    on_sweeps: OnSweeps | None = None,
) -> ViableSet:
    """The largest viable set, from the cache if it was computed before.

    Args:
        problem: a robot with two moving joints in its world.
        nodes: nodes per axis; along a joint that V - h does not depend on, as a cart before a wall, seven do.
        beyond_v: how far the grid reaches beyond X in v on either side, as a share of X's width.
        on_sweeps: called every few sweeps with their number and the largest change of V in the last one [m].

    Raises:
        InputError: if the robot has another number of joints.
        CheckFailed: if V has not settled after 3000 sweeps.
    """
    if problem.model.nv != 2:
        raise InputError(f"a viable set needs a robot with 2 moving joints, this one has {problem.model.nv}")
    if nodes < LEAST_NODES:
        raise InputError(f"a viable set needs at least {LEAST_NODES} nodes per axis, got {nodes}")
    grid = place_nodes(problem, (nodes,) * 4, beyond_v)
    tables = tabulate(problem, grid)
    needed = [LEAST_NODES if _alike(tables, i) else nodes for i in (0, 1)]
    grid = place_nodes(problem, (needed[0], needed[1], nodes, nodes), beyond_v)
    tables = tabulate(problem, grid)
    key = _digest(grid, tables)
    found = recall(key, grid.count) or _settle(grid, tables, on_sweeps)
    keep(key, *found)
    return ViableSet(problem.safety, grid, *found)


def place_nodes(problem: Problem, count: tuple[int, int, int, int], beyond_v: float) -> Nodes:
    """The grid: X and what lies around it; one turn of a joint that turns through X without meeting a limit."""
    model, domain = problem.model, problem.robot.domain
    bounds, periodic = np.concatenate([domain.q, domain.v]), [False] * 4
    for i in range(2):
        low, high = bounds[i]
        free = model.q_lower[i] < low and model.q_upper[i] > high
        turns = "P" not in model.model.joints[i + 1].shortname().removeprefix("JointModel")
        periodic[i] = bool(turns and free and high - low > 2.0 * np.pi - 1e-6)
        if periodic[i]:
            bounds[i] = low, low + 2.0 * np.pi
    margin = np.diff(bounds)[:, 0] * [BEYOND_Q, BEYOND_Q, beyond_v, beyond_v]
    margin[periodic] = 0.0
    return Nodes(bounds[:, 0] - margin, bounds[:, 1] + margin, count, (periodic[0], periodic[1], False, False))


def tabulate(problem: Problem, grid: Nodes) -> Tables:
    """Dynamics and h at the nodes of the two joints."""
    model, axes = problem.model, grid.axes[:2]
    q = model.from_angles(_pairs(axes))
    rest, first, second, both = (
        model.evaluate_batch(q, np.tile(v, (len(q), 1))) for v in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0])
    )
    bias = np.stack([rest.g, first.Cv, both.Cv - first.Cv - second.Cv, second.Cv], axis=-1)
    wide = [x[0] + (x[1] - x[0]) * np.arange(-GHOSTS, len(x) + GHOSTS) for x in axes]
    q = model.from_angles(_pairs(wide))
    h = problem.safety.evaluate(model.evaluate_batch(q, np.zeros((len(q), 2)))).h.min(-1)
    shape, a_0 = grid.count[:2], -rest.Minv @ bias
    return Tables(h.reshape(len(wide[0]), len(wide[1])), rest.Minv.reshape(*shape, 2, 2),
                  a_0.reshape(*shape, 2, 4), model.u_max)  # fmt: skip


def _pairs(axes: list[Array]) -> Array:
    """All nodes (n1 n2, 2) of two axes."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)


def _alike(tables: Tables, joint: int) -> bool:
    """Whether V - h is the same all along a joint: dynamics are, and h falls or rises evenly."""
    spread = [np.ptp(x, axis=joint).max() for x in (tables.Minv, tables.a_0)]
    return bool(max(*spread, np.ptp(np.diff(tables.h, axis=joint))) < ALIKE)


def _digest(grid: Nodes, tables: Tables) -> str:
    """Name of the result: everything that it follows from."""
    settings = (VERSION, CFL, TOLERANCE, NEAR, grid.count, grid.periodic)
    return hashlib.sha256(
        repr(settings).encode() + b"".join(np.ascontiguousarray(x).tobytes() for x in (grid.low, grid.high, *tables))
    ).hexdigest()


class _Fields(NamedTuple):
    """The same on the whole grid, as jax arrays (n1, n2, n3, n4, ...); axes that do not matter have length 1."""

    h: Any  # with its ghosts
    x_rate: Any  # (..., 4): velocity, and acceleration without torque
    Minv: Any  # (..., 2, 2)
    u_max: Any
    speed: Any  # (..., 4): largest rate of the state under any torque


def _fields(grid: Nodes, tables: Tables) -> _Fields:
    h, Minv, a_0, u_max = (jnp.asarray(x, jnp.float32) for x in tables)
    v1, v2 = (jnp.asarray(x, jnp.float32) for x in grid.axes[2:])
    v1, v2 = jnp.meshgrid(v1, v2, indexing="ij")
    powers = jnp.stack([jnp.ones_like(v1), v1 * v1, v1 * v2, v2 * v2], -1)
    a_0 = jnp.einsum("abik,cdk->abcdi", a_0, powers)
    velocity = jnp.broadcast_to(jnp.stack([v1, v2], -1), a_0.shape)
    reach = jnp.abs(Minv) @ u_max
    speed = jnp.concatenate([jnp.abs(velocity), jnp.abs(a_0) + reach[:, :, None, None]], -1)
    rate = jnp.concatenate([velocity, a_0], -1)
    return _Fields(h[:, :, None, None], rate, Minv[:, :, None, None], u_max, speed)


def _slopes(grid: Nodes, loss: Any, h: Any) -> tuple[Any, Any]:
    """∂V/∂x (n1, n2, n3, n4, 4) from the left and from the right, of ``V = h + loss``."""
    sides = []
    for i, axis in enumerate(grid.axes):
        width = [(GHOSTS, GHOSTS) if j == i else (0, 0) for j in range(4)]
        V = jnp.pad(loss, width, "wrap" if grid.periodic[i] else "edge")
        V = V + h[slice(None) if i == 0 else INNER, slice(None) if i == 1 else INNER]
        slopes = functools.partial(WENO3, spacing=axis[1] - axis[0], boundary_condition=lambda values, _: values)
        sides.append(hj.utils.multivmap(slopes, np.array([j for j in range(4) if j != i]))(V))
    left, right = zip(*sides, strict=True)
    return jnp.stack(left, -1), jnp.stack(right, -1)


def _settle(grid: Nodes, tables: Tables, on_sweeps: OnSweeps | None) -> tuple[Any, int]:
    """V - h (of grid.count) when V no longer changes, and the number of sweeps."""
    spacing = np.array([x[1] - x[0] for x in grid.axes], dtype=np.float32)

    def rate(loss: Any, f: _Fields) -> Any:
        """max_u dV/dt with Lax-Friedrichs dissipation, (n1, n2, n3, n4)."""
        left, right = _slopes(grid, loss, f.h)
        slope = (left + right) / 2.0
        push = (jnp.abs((f.Minv * slope[..., None, 2:]).sum(-1)) * f.u_max).sum(-1)
        return (slope * f.x_rate).sum(-1) + push + ((right - left) * f.speed).sum(-1) / 2.0

    @jax.jit
    def sweep(loss: Any, f: _Fields) -> tuple[Any, Any]:
        step = CFL / (f.speed / spacing).sum(-1)

        def once(_: int, state: tuple[Any, Any]) -> tuple[Any, Any]:
            old = state[0]
            once_on = old + step * rate(old, f)
            new = jnp.minimum((old + once_on + step * rate(once_on, f)) / 2.0, 0.0)
            return new, jnp.where(new + f.h[INNER, INNER] >= -NEAR, jnp.abs(old - new), 0.0).max()

        return jax.lax.fori_loop(0, SWEEPS, once, (loss, jnp.float32(0.0)))  # type: ignore[no-any-return]

    fields, loss = _fields(grid, tables), jnp.zeros(grid.count, jnp.float32)
    for done in range(SWEEPS, MAX_SWEEPS + 1, SWEEPS):
        loss, change = sweep(loss, fields)
        if on_sweeps is not None:
            on_sweeps(done, float(change))
        if change <= TOLERANCE:
            return np.asarray(loss), done
    raise CheckFailed(f"the viable set has not settled after {MAX_SWEEPS} sweeps: V still changes by {change:.2g} m")
