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
braking one joint hard may drive another far beyond its range for a while. At the grid's own edge the state is held,
which is too kind to motions beyond it; the more the grid reaches beyond X, the less that counts.

Needs the extra ``study`` (jax, hj_reachability).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import hj_reachability as hj
import jax
import jax.numpy as jnp
import numpy as np

from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array
from ppcbf_robots.viable_set import Nodes, ViableSet, keep, recall

VERSION = 1  # of the method: another one finds nothing in the cache
NODES = 31  # per axis
BEYOND_Q = 0.2  # of X's width, by which the grid reaches beyond X on either side
BEYOND_V = 1.0
CFL = 0.8
TOLERANCE = 1e-4  # [m], largest change of V in one sweep when it counts as settled
SWEEPS = 25  # between two looks at the change
MAX_SWEEPS = 3000

OnSweeps = Callable[[int, float], None]


class Tables(NamedTuple):
    """What the dynamics are on the grid, from Pinocchio; nodes of the two joints first."""

    h: Array  # (n1, n2) least row of the safety function
    Minv: Array  # (n1, n2, 2, 2)
    a_0: Array  # (n1, n2, 2, 4): acceleration without torque, to be multiplied by 1, v1², v1 v2, v2²
    u_max: Array  # (2,)


def solve(
    problem: Problem,
    nodes: int | tuple[int, int, int, int] = NODES,
    beyond_v: float = BEYOND_V,
    on_sweeps: OnSweeps | None = None,
) -> ViableSet:
    """The largest viable set, from the cache if it was computed before.

    Args:
        problem: a robot with two moving joints in its world.
        nodes: nodes per axis, or of each axis (q1, q2, v1, v2).
        beyond_v: how far the grid reaches beyond X in v on either side, as a share of X's width.
        on_sweeps: called every few sweeps with their number and the largest change of V in the last one [m].

    Raises:
        InputError: if the robot has another number of joints.
        CheckFailed: if V has not settled after 3000 sweeps.
    """
    if problem.model.nv != 2:
        raise InputError(f"a viable set needs a robot with 2 moving joints, this one has {problem.model.nv}")
    count = (nodes,) * 4 if isinstance(nodes, int) else nodes
    if min(count) < 7:
        raise InputError(f"a viable set needs at least 7 nodes per axis, got {min(count)}")
    grid = place_nodes(problem, count, beyond_v)
    tables = tabulate(problem, grid)
    key = _digest(grid, tables)
    found = recall(key, count) or _settle(grid, tables, on_sweeps)
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
    angles = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    q = model.from_angles(angles)
    rest, first, second, both = (
        model.evaluate_batch(q, np.tile(v, (len(q), 1))) for v in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0])
    )
    bias = np.stack([rest.g, first.Cv, both.Cv - first.Cv - second.Cv, second.Cv], axis=-1)
    shape = grid.count[:2]
    h = problem.safety.evaluate(rest).h.min(-1)
    a_0 = -rest.Minv @ bias
    return Tables(h.reshape(shape), rest.Minv.reshape(*shape, 2, 2), a_0.reshape(*shape, 2, 4), model.u_max)


def _digest(grid: Nodes, tables: Tables) -> str:
    """Name of the result: everything that it follows from."""
    settings = (VERSION, CFL, TOLERANCE, grid.count, grid.periodic)
    return hashlib.sha256(
        repr(settings).encode() + b"".join(np.ascontiguousarray(x).tobytes() for x in (grid.low, grid.high, *tables))
    ).hexdigest()


class _Fields(NamedTuple):
    """The same on the whole grid, as jax arrays (n1, n2, n3, n4, ...); axes that do not matter have length 1."""

    h: Any
    x_rate: Any  # (..., 4): velocity, and acceleration without torque
    Minv: Any  # (..., 2, 2)
    u_max: Any
    speed: Any  # (..., 4): largest rate of the state under any torque


def _fields(grid: Nodes, tables: Tables) -> _Fields:
    t = Tables(*(jnp.asarray(x, jnp.float32) for x in tables))
    v1, v2 = (jnp.asarray(x, jnp.float32) for x in grid.axes[2:])
    v1, v2 = jnp.meshgrid(v1, v2, indexing="ij")
    powers = jnp.stack([jnp.ones_like(v1), v1 * v1, v1 * v2, v2 * v2], -1)
    a_0 = jnp.einsum("abik,cdk->abcdi", t.a_0, powers)
    velocity = jnp.broadcast_to(jnp.stack([v1, v2], -1), a_0.shape)
    reach = jnp.abs(t.Minv) @ t.u_max
    speed = jnp.concatenate([jnp.abs(velocity), jnp.abs(a_0) + reach[:, :, None, None]], -1)
    rate = jnp.concatenate([velocity, a_0], -1)
    return _Fields(t.h[:, :, None, None], rate, t.Minv[:, :, None, None], t.u_max, speed)


def _hold(values: Any, width: int) -> Any:
    """Values beyond the edge: the edge's."""
    return jnp.pad(values, (width, width), "edge")


def _hj_grid(grid: Nodes) -> hj.Grid:
    edges = tuple(hj.boundary_conditions.periodic if p else _hold for p in grid.periodic)
    return hj.Grid.from_lattice_parameters_and_boundary_conditions(
        hj.sets.Box(grid.low, grid.high), grid.count, boundary_conditions=edges
    )


def _settle(grid: Nodes, tables: Tables, on_sweeps: OnSweeps | None) -> tuple[Any, int]:
    """V - h (of grid.count) when V no longer changes, and the number of sweeps."""
    lattice, fields = _hj_grid(grid), _fields(grid, tables)
    spacing = jnp.asarray(lattice.spacings)

    def v_rate(V: Any, f: _Fields) -> Any:
        """max_u dV/dt with Lax-Friedrichs dissipation, (n1, n2, n3, n4)."""
        left, right = lattice.upwind_grad_values(hj.finite_differences.upwind_first.WENO3, V)
        slope = (left + right) / 2.0
        push = (jnp.abs((f.Minv * slope[..., None, 2:]).sum(-1)) * f.u_max).sum(-1)
        return (slope * f.x_rate).sum(-1) + push + ((right - left) * f.speed).sum(-1) / 2.0

    @jax.jit
    def sweep(V: Any, f: _Fields) -> tuple[Any, Any]:
        step = CFL / (f.speed / spacing).sum(-1)

        def once(_: int, state: tuple[Any, Any]) -> tuple[Any, Any]:
            V = state[0]
            V1 = V + step * v_rate(V, f)
            new = jnp.minimum((V + V1 + step * v_rate(V1, f)) / 2.0, f.h)
            return new, jnp.abs(new - V).max()

        return jax.lax.fori_loop(0, SWEEPS, once, (V, jnp.float32(0.0)))  # type: ignore[no-any-return]

    V = jnp.broadcast_to(fields.h, grid.count)
    for done in range(SWEEPS, MAX_SWEEPS + 1, SWEEPS):
        V, change = sweep(V, fields)
        if on_sweeps is not None:
            on_sweeps(done, float(change))
        if change <= TOLERANCE:
            return np.minimum(np.asarray(V - fields.h), np.float32(0.0)), done
    raise CheckFailed(f"the viable set has not settled after {MAX_SWEEPS} sweeps: V still changes by {change:.2g} m")
