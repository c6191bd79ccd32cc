"""What independent states of the band say about all of it: exact confidence bounds of the violation measure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import betaincinv

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.errors import CheckFailed
from ppcbf_robots.evidence import POWER_TOLERANCE, least_phi
from ppcbf_robots.filters import FilterConfig, Status, free_power
from ppcbf_robots.problem import Problem
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array

CHUNK = 2000  # states of X drawn at once
MAX_TRIED = 2_000_000  # states of X without a single one on the band after which it counts as empty
TORQUE_TOLERANCE = 1e-6  # of u_max
KEPT = 50  # violating states that are kept of each kind
CONDITIONS = ("input_bounds", "feasibility", "passivity")


@dataclass
class BandCounts:
    """Violations of each condition among independent uniform states of the band."""

    samples: int = 0
    tried: int = 0  # states of X drawn to find the samples
    violations: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CONDITIONS, 0))
    states: dict[str, list[list[float]]] = field(default_factory=lambda: {name: [] for name in CONDITIONS})

    def add(self, other: BandCounts) -> None:
        """Count further states."""
        self.samples += other.samples
        self.tried += other.tried
        for name in CONDITIONS:
            self.violations[name] += other.violations[name]
            self.states[name] = (self.states[name] + other.states[name])[:KEPT]


def clopper_pearson(violations: int, samples: int, confidence: float) -> float:
    """Upper bound of a probability that holds with ``confidence``, after so many hits in independent samples.

    Clopper & Pearson, *Biometrika* 26 (1934), one-sided: where so few hits or fewer have probability 1 - confidence.
    """
    if violations >= samples:
        return 1.0
    return float(betaincinv(violations + 1, samples - violations, confidence))


def independent_band(
    problem: Problem, barrier: Barrier, count: int, rng: np.random.Generator, width: float | None = None
) -> tuple[Array, Array, int]:
    """Independent states, uniform on ``{0 <= min_k phi_k <= width, h >= 0}`` in X: q (n, nq), v (n, nv), tried.

    ``width`` is epsilon by default. Plain rejection: every state of X is drawn anew, position and velocity, and kept if
    it lies on the band. (In :func:`ppcbf_robots.evidence.uniform_band` several states may share a position.)

    Raises:
        CheckFailed: if X seems to hold no state of the band.
    """
    model, domain, epsilon = problem.model, problem.robot.domain, barrier.spec.epsilon if width is None else width
    kept_q: list[Array] = []
    kept_v: list[Array] = []
    found = tried = 0
    while found < count:
        q = model.from_angles(domain.sample_q(rng, CHUNK))
        v = domain.sample_v(rng, CHUNK)
        h, grad = problem.safety.first_order(q)
        free = np.flatnonzero(h.min(axis=-1) >= 0.0)
        if free.size:
            phi = least_phi(problem, barrier, q[free], h[free], grad[free], v[free, None])[:, 0]
            on = free[(phi >= 0.0) & (phi <= epsilon)][: count - found]
            kept_q.append(q[on])
            kept_v.append(v[on])
            found += len(on)
        tried += CHUNK if found < count else int(on[-1]) + 1  # those after the last that was wanted say nothing
        if not found and tried >= MAX_TRIED:
            raise CheckFailed(f"none of {tried:,} uniform states of X lies on the band: the safe set has collapsed")
    return np.concatenate(kept_q), np.concatenate(kept_v), tried


def count_violations(
    problem: Problem, barrier: Barrier, config: FilterConfig, passive: bool, q: Array, v: Array
) -> BandCounts:
    """What the runtime filter does at states q (n, nq), v (n, nv), with the problem's controller.

    * input_bounds: a torque beyond u_max.
    * feasibility: no torque within the limits satisfies all rows; closed form: L_g phi = 0.
    * passivity (if ``passive``): ``v · (u - u_des)`` beyond d_p, or given up by the QP filter. The closed form is
      allowed 5e-4 of ``u_max · v_max``, the QP filter what it allows itself.
    """
    runtime = SafetyFilter(problem.model, problem.safety, barrier, config)
    u_max = problem.model.u_max
    allowed = POWER_TOLERANCE * float(u_max @ np.abs(problem.robot.domain.v).max(axis=1))
    counts = BandCounts(samples=len(q))
    for qi, vi in zip(q, v, strict=True):
        dyn = problem.model.evaluate(qi, vi)
        nominal = problem.robot.controller.evaluate(dyn)
        result = runtime.filter(dyn, nominal.u, float(nominal.d_p) if passive else None)
        too_much = float(vi @ (result.u - nominal.u)) - float(nominal.d_p)
        acted = result.status is not Status.FREE
        broken = {
            "input_bounds": acted and bool(np.any(np.abs(result.u) > u_max * (1.0 + TORQUE_TOLERANCE))),
            "feasibility": result.status >= Status.INFEASIBLE,
        }
        if config.kind == "closed-form":
            broken["passivity"] = acted and too_much > allowed
        else:
            free = free_power(problem.model)
            exceeds = acted and too_much > free + TORQUE_TOLERANCE * allowed / POWER_TOLERANCE
            broken["passivity"] = result.status >= Status.PASSIVITY_DROPPED or exceeds
        for name, bad in broken.items():
            if bad and (name != "passivity" or passive):
                counts.violations[name] += 1
                if len(counts.states[name]) < KEPT:
                    counts.states[name].append([*problem.model.to_angles(qi).tolist(), *vi.tolist()])
    return counts
