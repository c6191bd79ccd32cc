"""How large safe sets are, next to one another and to the viable set: by uniform states of X."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.filters import FilterConfig, Status
from ppcbf_robots.problem import Problem
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array
from ppcbf_robots.viable_set import ViableSet

CHUNK = 1000
FREE, VIABLE = "h >= 0", "viable"

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Ratio:
    """Volume of one set over that of another, with its standard error."""

    value: float
    error: float


@dataclass(frozen=True)
class Membership:
    """How many of the same uniform states of X lie in which sets."""

    names: tuple[str, ...]  # FREE, VIABLE if it is known, and the barriers' sets
    samples: int
    both: NDArray[np.int64]  # (sets, sets): states in the one and the other; on the diagonal, in the one

    @classmethod
    def of(cls, inside: Mapping[str, Mask]) -> Membership:
        """Counts of masks (samples,) by name."""
        masks = np.array(list(inside.values()), dtype=np.int64)
        return cls(tuple(inside), masks.shape[1], masks @ masks.T)

    def __add__(self, other: Membership) -> Membership:
        """With other states counted too."""
        assert self.names == other.names
        return Membership(self.names, self.samples + other.samples, self.both + other.both)

    def ratio(self, name: str, reference: str | None = None) -> Ratio:
        """Volume of a set over that of a reference, None for X itself; NaN where the reference is empty."""
        i = self.names.index(name)
        a = shared = float(self.both[i, i])
        b = float(self.samples)
        if reference is not None:
            j = self.names.index(reference)
            b, shared = float(self.both[j, j]), float(self.both[i, j])
        if not b:
            return Ratio(float("nan"), float("nan"))
        value = a / b
        return Ratio(value, math.sqrt(max(a - 2.0 * value * shared + value * value * b, 0.0)) / b)

    def outside(self, name: str, reference: str) -> float:
        """Share of a set that lies outside a reference; NaN where the set is empty."""
        i, j = self.names.index(name), self.names.index(reference)
        return float(1.0 - self.both[i, j] / self.both[i, i]) if self.both[i, i] else float("nan")


def membership(
    problem: Problem,
    barriers: Mapping[str, Barrier],
    viable: ViableSet | None,
    count: int,
    rng: np.random.Generator,
) -> Membership:
    """The sets ``{h >= 0, min_k phi_k >= 0}`` of barriers, ``{h >= 0}`` and the viable set on uniform states of X."""
    domain, parts = problem.robot.domain, []
    for n in _chunks(count):
        q = problem.model.from_angles(domain.sample_q(rng, n))
        parts.append(levels_at(problem, barriers, viable, q, domain.sample_v(rng, n)))
    return Membership.of({name: np.concatenate([part[name] for part in parts]) >= 0.0 for name in parts[0]})


def levels_at(
    problem: Problem, barriers: Mapping[str, Barrier], viable: ViableSet | None, q: Array, v: Array
) -> dict[str, Array]:
    """By set, the least of h and phi at the states q (B, nq), v (B, nv): (B,), not negative inside."""
    dyn = problem.model.evaluate_batch(q, v)
    safety = problem.safety.evaluate(dyn)
    h = safety.h.min(axis=-1)
    levels = {FREE: h}
    if viable is not None:
        levels[VIABLE] = viable.value_from(h, q, v)
    for name, barrier in barriers.items():
        levels[name] = np.minimum(h, barrier.rows(dyn, safety).phi.min(axis=-1))
    return levels


@dataclass(frozen=True)
class BoundaryCheck:
    """States near the boundary of a safe set, and how many of them no torque in the box keeps inside."""

    samples: int
    infeasible: int

    @property
    def share(self) -> float:
        """Infeasible states per state; NaN without states."""
        return self.infeasible / self.samples if self.samples else float("nan")


def check_boundary(
    problem: Problem, barrier: Barrier, count: int, rng: np.random.Generator, max_tried: int = 200_000
) -> BoundaryCheck:
    """Whether some torque in the box satisfies all rows of a barrier, by the QP, on uniform states near the boundary.

    Near means h >= 0 and ``0 <= min_k phi_k <= epsilon``; the PP-CBF's phi is an energy, so its width is
    ``alpha_pp epsilon / gamma``, the same distance in h. Passivity is not asked for, nor the velocity range of X.
    """
    spec = barrier.spec
    width = spec.alpha_pp * spec.epsilon / spec.gamma if barrier.kind == "pp-cbf" else spec.epsilon
    runtime = SafetyFilter(problem.model, problem.safety, barrier, FilterConfig(margin=0.0))
    samples = infeasible = 0
    for n in _chunks(max_tried):
        q = problem.model.from_angles(problem.robot.domain.sample_q(rng, n))
        v = problem.robot.domain.sample_v(rng, n)
        dyn = problem.model.evaluate_batch(q, v)
        safety = problem.safety.evaluate(dyn)
        phi = barrier.rows(dyn, safety).phi.min(axis=-1)
        near = (safety.h.min(axis=-1) >= 0.0) & (phi >= 0.0) & (phi <= width)
        for i in np.flatnonzero(near)[: count - samples]:
            at = problem.model.evaluate(q[i], v[i])
            u_des = problem.robot.controller.evaluate(at).u
            infeasible += runtime.filter(at, u_des, None).status >= Status.PASSIVITY_DROPPED
            samples += 1
        if samples == count:
            break
    return BoundaryCheck(samples, int(infeasible))


def _chunks(count: int) -> list[int]:
    """``count`` in pieces of at most 1000."""
    return [min(CHUNK, count - done) for done in range(0, count, CHUNK)]
