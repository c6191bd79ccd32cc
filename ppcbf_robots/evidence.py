"""Independent checks of a barrier: uniform states on its band, given to the filter that will run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ppcbf_robots.barriers import Barrier
from ppcbf_robots.filters import FilterConfig, Status, band_width
from ppcbf_robots.problem import Problem
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array

CHUNK = 1000
POWER_TOLERANCE = 5e-4  # of u_max · v_max; with 1e-3 the cart-pole's storage crept up by 2e-3 of itself
VELOCITIES = 20  # tried per configuration
MAX_CONFIGURATIONS = 60_000  # tried before a band counts as too thin


@dataclass(frozen=True)
class BandCheck:
    """What the runtime filter did on states of the band."""

    samples: int
    violations: int  # torque beyond the box, energy beyond d_p, or no feasible torque
    tried: int  # states of X drawn to find the samples
    bad_q: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (violations, nq)
    bad_v: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (violations, nv)

    @property
    def share(self) -> float:
        """Violations per sample; NaN without samples."""
        return self.violations / self.samples if self.samples else float("nan")


def uniform_band(
    problem: Problem,
    barrier: Barrier,
    count: int,
    rng: np.random.Generator,
    max_configurations: int = MAX_CONFIGURATIONS,
    width: float | None = None,
) -> tuple[Array, Array, int]:
    """States uniform on ``{0 <= min_k phi_k <= width, h >= 0}`` by rejection: q (n, nq), v (n, nv), states tried.

    ``width`` is epsilon by default.

    Every configuration is tried with 20 velocities, so states may share a configuration. Fewer than ``count`` come back
    when the band is too thin.
    """
    model, domain, eps = problem.model, problem.robot.domain, barrier.spec.epsilon if width is None else width
    found_q: list[Array] = []
    found_v: list[Array] = []
    found = tried = 0
    for _ in range(max(1, max_configurations // CHUNK)):
        q = model.from_angles(domain.sample_q(rng, CHUNK))
        dyn = model.evaluate_batch(q, np.zeros((CHUNK, model.nv)))
        safety = problem.safety.evaluate(dyn)
        free = np.flatnonzero(safety.h.min(axis=-1) >= 0.0)
        if not free.size:
            continue
        v = domain.sample_v(rng, len(free) * VELOCITIES).reshape(len(free), VELOCITIES, model.nv)
        phi = least_phi(problem, barrier, q[free], safety.h[free], safety.grad[free], v)
        i, j = np.nonzero((phi >= 0.0) & (phi <= eps))
        found_q.append(q[free][i])
        found_v.append(v[i, j])
        found, tried = found + len(i), tried + CHUNK * VELOCITIES
        if found >= count:
            break
    q = np.concatenate(found_q)[:count] if found_q else np.zeros((0, model.nq))
    v = np.concatenate(found_v)[:count] if found_v else np.zeros((0, model.nv))
    return q, v, tried


def least_phi(problem: Problem, barrier: Barrier, q: Array, h: Array, grad: Array, v: Array) -> Array:
    """min_k phi_k at velocities v (B, V, nv) of configurations q (B, nq), for rho barriers.

    Where it is negative, some of K may be missing: K >= 0 only takes away from it, and is what takes time.
    """
    network = getattr(barrier, "network", None)
    phi = np.asarray((v @ grad.transpose(0, 2, 1) + barrier.spec.gamma * h[:, None, :]).min(axis=-1))
    if network is None:
        return phi
    if network.kind == "convex":  # its layers see q alone: once per configuration
        phi = np.asarray(phi - network.value(q[:, None], v))
    else:
        b, i = np.nonzero(phi >= 0.0)
        phi[b, i] -= network.value(q[b], v[b, i])
    b, i = np.nonzero(phi >= 0.0)
    if network.energy and len(b):
        chosen, index = np.unique(b, return_inverse=True)
        M = problem.model.evaluate_batch(q[chosen], np.zeros((len(chosen), problem.model.nv))).M[index]
        moving = v[b, i]
        phi[b, i] -= 0.5 * network.energy * (moving * (M @ moving[..., None])[..., 0]).sum(-1)
    return phi


def volume_ratio(
    problem: Problem, barrier: Barrier, reference: Barrier, rng: np.random.Generator, count: int = 10_000
) -> float:
    """Volume in X of ``{h >= 0, min_k phi_k >= 0}`` of a barrier over that of a reference, by uniform samples."""
    inside = np.zeros(2)
    for _ in range(-(-count // CHUNK)):
        q = problem.model.from_angles(problem.robot.domain.sample_q(rng, CHUNK))
        dyn = problem.model.evaluate_batch(q, problem.robot.domain.sample_v(rng, CHUNK))
        safety = problem.safety.evaluate(dyn)
        free = safety.h.min(axis=-1) >= 0.0
        inside += [np.sum(free & (b.rows(dyn, safety).phi.min(axis=-1) >= 0.0)) for b in (barrier, reference)]
    return float(inside[0] / max(inside[1], 1.0))


def check_band(
    problem: Problem,
    barrier: Barrier,
    config: FilterConfig,
    count: int,
    rng: np.random.Generator,
    passive: bool = True,
    max_configurations: int = MAX_CONFIGURATIONS,
) -> BandCheck:
    """Run the filter on uniform band states with the problem's controller and count violations.

    Closed form: a violation is a torque above u_max, or (if ``passive``) ``vᵀ u_sc`` above d_p by more than 5e-4 of the
    largest power u_max · v_max: near rest the paper's condition cannot hold exactly. QP: no torque in the box satisfies
    all rows with the passivity row (without it if not ``passive``).
    """
    width = band_width(barrier.spec, config.kind)
    q, v, tried = uniform_band(problem, barrier, count, rng, max_configurations, width)
    runtime = SafetyFilter(problem.model, problem.safety, barrier, config)
    u_max = problem.model.u_max
    power_tolerance = POWER_TOLERANCE * float(u_max @ np.abs(problem.robot.domain.v).max(axis=1))
    bad_states = []
    for qi, vi in zip(q, v, strict=True):
        dyn = problem.model.evaluate(qi, vi)
        nominal = problem.robot.controller.evaluate(dyn)
        result = runtime.filter(dyn, nominal.u, float(nominal.d_p) if passive else None)
        bad = result.status >= Status.PASSIVITY_DROPPED
        if config.kind == "closed-form" and result.status is not Status.FREE:
            power, d_p = float(vi @ (result.u - nominal.u)), float(nominal.d_p)
            bad = bad or bool(np.any(np.abs(result.u) > u_max * (1.0 + 1e-6)))
            bad = bad or (passive and power > d_p + power_tolerance)
        if bad:
            bad_states.append((qi, vi))
    bad_q, bad_v = (np.array(x) for x in zip(*bad_states, strict=True)) if bad_states else (q[:0], v[:0])
    return BandCheck(len(q), len(bad_states), tried, bad_q, bad_v)
