"""Search for band states without a feasible torque for the runtime filter: many small evolution strategies at once.

The margin is a function of q, of the direction d of v and of the level of phi, between the filter's own margin and
epsilon; the speed follows. What is searched for is the least *reserve*, the margin over what the torque limits can do
(:meth:`ppcbf_robots.learning.critics.Feasibility.capability`): the margin itself draws nearly all starts to rest, or to
where two rows brake each other, and it is small and positive there whatever the barrier. It has kinks (another row,
another vertex of the box), where gradients lead astray: every start draws points about itself instead, some in all
coordinates, some in a few, and some where it last went, and moves to the best. Those that fall behind the others give
way to fresh ones. The same number of points finds some twenty times as many states as differences and gradients do.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.filters import FilterConfig
from ppcbf_robots.learning.band import Band
from ppcbf_robots.learning.rays import Rays, rays_at, to_tensors
from ppcbf_robots.network import NumpyNetwork
from ppcbf_robots.problem import Problem
from ppcbf_robots.specs import Array

ROWS = 16  # nearest rows that a barrier as it runs is judged by
STARTS = 96  # searched from at once; a state costs a quarter less than with 48
FRESH = 40  # random points for every start, of which the worst is taken
PROBES = 12  # points drawn about every start in a round
SPARSE = 0.25  # of the coordinates, changed by half of the probes
SPREAD = (-1.5, 1.0)  # log of the probes' size over the step
FIRST_STEP, LARGEST_STEP = 0.02, 0.1  # of X's width
LAST_STEP = 2e-4  # below which a start is given up and replaced
LONGER, SHORTER = 1.25, 0.85  # factors on the step after a better point, and after none
CULLING = 20  # rounds after which ...
CULLED = 0.33  # ... this share of the starts, those of the largest margins, is replaced if as old


@dataclass(frozen=True)
class Attack:
    """What a search found."""

    worst: float  # least reserve seen
    q: Array  # (found, nq) states that violate
    v: Array  # (found, nv)
    evaluated: int


@dataclass
class Starts:
    """Where a search stands: B starts of n = 2 nv + 1 coordinates."""

    points: Array  # (B, n)
    value: Array  # (B,) reserves
    step: Array  # (B,) of X's width
    drift: Array  # (B, n) where each last went
    age: Array  # (B,) rounds


class Falsifier:
    """Searches for states of small reserve.

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

    @torch.inference_mode()
    def reserves(self, params: Mapping[str, torch.Tensor], points: Array) -> tuple[Array, Array, Array]:
        """Reserves (B,) of points (B, 2 nv + 1), infinite off the band, and their states q, v.

        A point is an angle and a direction of motion for each joint, and the level of phi by its share of the band.
        """
        nq, nv = self.problem.model.nq, self.problem.model.nv
        if not len(points):
            return np.zeros(0), np.zeros((0, nq)), np.zeros((0, nv))
        q = self.problem.model.from_angles(points[:, :nv])
        arrays, _, free = rays_at(self.problem, q, points[:, nv:-1], self.rows)
        device, dtype = self.band.u_max.device, self.band.u_max.dtype
        index = np.flatnonzero(free)
        reserve, v = np.full(len(points), np.inf), np.zeros((len(points), nv))
        if len(index):
            rays = Rays(**to_tensors([{k: x[index] for k, x in arrays.items()}], device, dtype))
            level = torch.as_tensor(self.band.level(points[index, -1]), device=device, dtype=dtype)
            on, s = self.band.field.on_band(params, rays, level, rising=True)
            index, chosen = index[on.cpu().numpy()], rays.select(on)
            reserve[index] = self.band.reserve(params, chosen, s).cpu().numpy()
            v[index] = (s[:, None] * chosen.d).cpu().numpy()
        return reserve, q, v

    def start(self, count: int = STARTS) -> Starts:
        """No search yet: every start is replaced at once."""
        n = len(self._low)
        return Starts(np.zeros((count, n)), np.full(count, np.inf), np.zeros(count), np.zeros((count, n)),
                      np.zeros(count, dtype=np.int64))  # fmt: skip

    def search(
        self,
        params: Mapping[str, torch.Tensor],
        rounds: int | None = None,
        seconds: float = float("inf"),
        starts: Starts | None = None,
        enough: float = float("inf"),
        linger: float = float("inf"),
    ) -> Attack:
        """Descend until rounds or seconds are used up, or ``enough`` violating states were found.

        It also ends ``linger`` rounds after the first of these.

        ``starts`` of an earlier search, with other parameters or not, go on and are changed in place.
        """
        began, done, first, found = time.monotonic(), 0, 1, _Found()
        if starts is None:
            starts = self.start()
        known = starts.step > 0.0
        starts.value[known] = found.add(*self.reserves(params, starts.points[known]))
        self._replace(params, starts, ~known, found)
        last = float("inf") if rounds is None else rounds
        while done < last and time.monotonic() - began < seconds and found.states < enough:
            self._descend(params, starts, found)
            done += 1
            if found.states:
                last = min(last, first + linger)
            else:
                first = done + 1
            over = starts.step < LAST_STEP
            if done % CULLING == 0:
                old = np.flatnonzero(starts.age >= CULLING)
                behind = old[np.argsort(-starts.value[old])][: int(CULLED * len(starts.value))]
                over[behind] = True
                over[old[starts.value[old] < 0.0]] = True  # elsewhere there may be others
            self._replace(params, starts, over, found)
        return found.attack(self.problem.model.nq, self.problem.model.nv)

    def _replace(self, params: Mapping[str, torch.Tensor], starts: Starts, over: NDArray[np.bool_],
                 found: _Found) -> None:  # fmt: skip
        """Put the worst of random points in the places of starts that are over."""
        count = int(over.sum())
        if not count:
            return
        points = self._drawn(FRESH * count)
        value = found.add(*self.reserves(params, points))
        worst = np.argsort(value)[:count]
        starts.points[over], starts.value[over] = points[worst], value[worst]
        starts.step[over], starts.drift[over], starts.age[over] = FIRST_STEP, 0.0, 0

    def _drawn(self, count: int) -> Array:
        """Random points: half of them uniform, half with joints that run into bounds of X."""
        points, cornered = self.rng.uniform(self._low, self._high, (count, len(self._low))), count // 2
        domain, gamma = self.problem.robot.domain, self.problem.robot.spec.barrier.gamma
        points[:cornered, :-1] = np.concatenate(domain.sample_cornered(self.rng, cornered, gamma), axis=1)
        return points

    def _descend(self, params: Mapping[str, torch.Tensor], starts: Starts, found: _Found) -> None:
        """One round: probes about every start, of which the best takes its place if it is better."""
        points, (B, n) = starts.points, starts.points.shape
        share = np.where(self.rng.random((B, PROBES, 1)) < 0.5, 1.0, SPARSE)
        size = np.exp(self.rng.uniform(*SPREAD, (B, PROBES, 1))) * starts.step[:, None, None] * self._width
        away = self.rng.normal(size=(B, PROBES, n)) * (self.rng.random((B, PROBES, n)) < share) * size
        away[:, 0] = 2.0 * starts.drift
        away[:, 1] = 0.7 * starts.drift + 0.5 * away[:, 1]
        tried = np.clip(points[:, None] + away, self._low, self._high)
        values = found.add(*self.reserves(params, tried.reshape(-1, n))).reshape(B, PROBES)
        start, best = np.arange(B), values.argmin(1)
        better = values[start, best] < starts.value
        moved = np.where(better[:, None], tried[start, best], points)
        starts.drift = 0.5 * (starts.drift + moved - points)
        starts.points, starts.value = moved, np.where(better, values[start, best], starts.value)
        starts.step = np.minimum(starts.step * np.where(better, LONGER, SHORTER), LARGEST_STEP)
        starts.age += 1


class _Found:
    """Violating states among all that were judged."""

    def __init__(self) -> None:
        self.worst, self.judged, self.states = float("inf"), 0, 0
        self._q: list[Array] = []
        self._v: list[Array] = []

    def add(self, reserve: Array, q: Array, v: Array) -> Array:
        """Take note of states, and return their reserves."""
        bad = reserve < 0.0
        self.worst, self.judged = min(self.worst, float(reserve.min(initial=np.inf))), self.judged + len(reserve)
        self.states += int(bad.sum())
        if bad.any():
            self._q.append(q[bad])
            self._v.append(v[bad])
        return reserve

    def attack(self, nq: int, nv: int) -> Attack:
        q = np.concatenate([np.zeros((0, nq)), *self._q])
        return Attack(self.worst, q, np.concatenate([np.zeros((0, nv)), *self._v]), self.judged)


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
