"""Search for band states without a feasible torque for the runtime filter: descent on the exact margin, many starts.

The margin is a function of q, of the direction d of v and of the level of phi; the speed follows. Gradients are finite
differences through Pinocchio and the geometry, all starts at once; the differences themselves are candidates too, so
that kinks (another row, another vertex of the box) do not stop the search.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.learning.band import Band
from ppcbf_robots.learning.rays import Rays, rays_at, to_tensors
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

ROWS = 16  # nearest rows that a barrier as it runs is judged by
STARTS = 48  # searched from at once
PROBES = 40  # random points for every start, of which the worst is taken
FIRST_STEP = 0.02  # of X's width, of the finite differences
LAST_STEP = 2e-4  # below which a start is given up and replaced
STRIDES = (0.5, 2.0, 8.0)  # gradient steps tried, in units of the difference's step


@dataclass(frozen=True)
class Attack:
    """What a search found."""

    worst: float  # least margin seen
    q: Array  # (found, nq) states with a negative margin
    v: Array  # (found, nv)
    evaluated: int


class Falsifier:
    """Searches for states of negative margin.

    Args:
        problem: robot, world and controller, with the gamma of the barrier.
        band: how states are judged.
        rows: near rows per ray.
        rng: source of randomness.
    """

    def __init__(self, problem: Problem, band: Band, rows: int, rng: np.random.Generator) -> None:
        self.problem, self.band, self.rows, self.rng = problem, band, rows, rng
        domain = problem.robot.domain
        self._low = np.concatenate([domain.q[:, 0], domain.v[:, 0], [0.0]])
        self._high = np.concatenate([domain.q[:, 1], domain.v[:, 1], [1.0]])
        self._width = self._high - self._low

    def margins(self, params: Mapping[str, torch.Tensor], points: Array) -> tuple[Array, Array, Array]:
        """Margins (B,) of points (B, 2 nv + 1), infinite off the band, and their states q, v.

        A point is an angle and a direction of motion for each joint, and the level of phi over epsilon.
        """
        nq, nv = self.problem.model.nq, self.problem.model.nv
        if not len(points):
            return np.zeros(0), np.zeros((0, nq)), np.zeros((0, nv))
        q = self.problem.model.from_angles(points[:, :nv])
        arrays, _, free = rays_at(self.problem, q, points[:, nv:-1], self.rows)
        device, dtype = self.band.u_max.device, self.band.u_max.dtype
        index = np.flatnonzero(free)
        margin, v = np.full(len(points), np.inf), np.zeros((len(points), nv))
        if len(index):
            rays = Rays(**to_tensors([{k: x[index] for k, x in arrays.items()}], device, dtype))
            level = torch.as_tensor(points[index, -1] * self.band.epsilon, device=device, dtype=dtype)
            s, crosses = self.band.field.on_band(params, rays, level, rising=True)
            on = crosses.nonzero()[:, 0]
            index, chosen = index[on.cpu().numpy()], rays.select(on)
            margin[index] = self.band.margin(params, chosen, s[on]).detach().cpu().numpy()
            v[index] = (s[on, None] * chosen.d).cpu().numpy()
        return margin, q, v

    def search(
        self,
        params: Mapping[str, torch.Tensor],
        rounds: int | None = None,
        seconds: float = float("inf"),
        starts: Array | None = None,
    ) -> Attack:
        """Descend from the worst of random points, or ``starts`` (B, 2 nv + 1), until rounds or seconds are used up."""
        began, done = time.monotonic(), 0
        points, value, found, evaluated = self._fresh(params, STARTS) if starts is None else self._seen(params, starts)
        step = np.full(len(points), FIRST_STEP)
        worst = float(value.min(initial=np.inf))
        while (rounds is None or done < rounds) and time.monotonic() - began < seconds and len(points):
            points, value, step, new, count = self._descend(params, points, value, step)
            found += new
            worst = min(worst, float(value.min()))
            evaluated, done = evaluated + count, done + 1
            spent = step < LAST_STEP
            if spent.any():
                points[spent], value[spent], new, count = self._fresh(params, int(spent.sum()))
                step[spent], found, evaluated = FIRST_STEP, found + new, evaluated + count
                worst = min(worst, float(value.min()))
        nq, nv = self.problem.model.nq, self.problem.model.nv
        q = np.concatenate([x for x, _ in found]) if found else np.zeros((0, nq))
        v = np.concatenate([x for _, x in found]) if found else np.zeros((0, nv))
        return Attack(worst, q, v, evaluated)

    def _fresh(
        self, params: Mapping[str, torch.Tensor], count: int
    ) -> tuple[Array, Array, list[tuple[Array, Array]], int]:
        """The worst ``count`` of random points, as :meth:`_seen` has them, with the states found among all of them."""
        points, value, found, seen = self._seen(
            params, self.rng.uniform(self._low, self._high, (PROBES * count, len(self._low)))
        )
        worst = np.argsort(value)[:count]
        return points[worst], value[worst], found, seen

    def _seen(
        self, params: Mapping[str, torch.Tensor], points: Array
    ) -> tuple[Array, Array, list[tuple[Array, Array]], int]:
        """Points, their margins, the states of negative margin, and how many points these are."""
        value, q, v = self.margins(params, points)
        bad = value < 0.0
        return points, value, [(q[bad], v[bad])] if bad.any() else [], len(points)

    def _descend(
        self, params: Mapping[str, torch.Tensor], points: Array, value: Array, step: Array
    ) -> tuple[Array, Array, Array, list[tuple[Array, Array]], int]:
        """One round: differences in every coordinate, strides along the gradient, the best point seen of each start."""
        B, n = points.shape
        sign = np.where(self.rng.random((B, n)) < 0.5, -1.0, 1.0)
        tried = np.repeat(points[:, None], n, 1)
        tried[:, np.arange(n), np.arange(n)] += sign * step[:, None] * self._width
        tried = np.clip(tried, self._low, self._high)
        near, q, v = self.margins(params, tried.reshape(B * n, n))
        near = near.reshape(B, n)
        known = np.isfinite(near) & np.isfinite(value)[:, None]
        slope = sign * np.subtract(near, value[:, None], out=np.zeros_like(near), where=known)
        direction = -slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
        strides = np.array(STRIDES)[None, :, None] * step[:, None, None] * direction[:, None] * self._width
        along = np.clip(points[:, None] + strides, self._low, self._high)
        far, q_far, v_far = self.margins(params, along.reshape(-1, n))
        values = np.concatenate([near, far.reshape(B, -1)], 1)
        candidates = np.concatenate([tried, along], 1)
        best = values.argmin(1)
        start = np.arange(B)
        better = values[start, best] < value
        points = np.where(better[:, None], candidates[start, best], points)
        bad, bad_far = near.ravel() < 0.0, far < 0.0
        found = [(q[bad], v[bad]), (q_far[bad_far], v_far[bad_far])]
        return (points, np.where(better, values[start, best], value), np.where(better, step, 0.5 * step),
                [f for f in found if len(f[0])], values.size)  # fmt: skip


def falsify(
    problem: Problem, barrier: Barrier, config: FilterConfig, rng: np.random.Generator, seconds: float
) -> Attack:
    """Search against a barrier as it runs, in float64: an LB-CBF, NCBF or PP-NCBF with the QP filter.

    Args:
        problem: robot, world and controller; gamma is the barrier's.
        barrier: with or without a network.
        config: settings of the QP filter.
        rng: source of randomness.
        seconds: how long to search.
    """
    problem = problem.with_barrier_spec(barrier.spec)
    network = getattr(barrier, "network", None) or NumpyNetwork("convex", no_network(problem))
    device, dtype = torch.device("cpu"), torch.float64
    band = Band(problem, network.kind, config, barrier.kind != "ncbf", device, dtype)
    params = {k: torch.as_tensor(w, dtype=dtype) for k, w in network.params.items()}
    return Falsifier(problem, band, ROWS, rng).search(params, seconds=seconds)


def no_network(problem: Problem) -> dict[str, Array]:
    """Parameters of a convex form that is zero everywhere: no units, and no weight of the speed."""
    nq, nv = problem.model.nq, problem.model.nv
    shapes: dict[str, Any] = {f"{form}_{k}": () for form in ("cone", "bowl") for k in "ac"}
    shapes |= {"in_shift": nq, "in_scale": nq, "turns": nq, "v_scale": nv, "cone_b": nv, "bowl_b": nv}
    shapes |= {"ba": 0, "bb": 0, "bc": 0}
    heads = {name: np.zeros((3 * nq, 0)) for name in ("Wa", "Wb", "Wc")}
    return {name: np.zeros(size) for name, size in shapes.items()} | heads
