"""The proof about a trained barrier: what is claimed, what speaks against trying, and the conditions it ends with."""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ppcbf_robots.artefact import StoredBarrier
from ppcbf_robots.barriers import Barrier
from ppcbf_robots.certificate import Condition, Verdict, suffix
from ppcbf_robots.errors import CheckFailed, InputError
from ppcbf_robots.evidence import uniform_band
from ppcbf_robots.filters import FilterConfig, Status, free_power
from ppcbf_robots.plant import perturbed
from ppcbf_robots.problem import Problem
from ppcbf_robots.proof.boxes import FAIL, BoxJudge
from ppcbf_robots.proof.branch_and_bound import Search, begin, load_search, run, save_search
from ppcbf_robots.proof.witness import JOINTS, best_torque
from ppcbf_robots.safety_filter import SafetyFilter
from ppcbf_robots.specs import Array

VERSION = 1  # of what a state file holds
MARKERS = 4_000  # band states that show how far the proof is
RAY_STATES = 10_000  # at which v · ∂K/∂v >= K is looked at


@dataclass(frozen=True)
class Proof:
    """A proof that has ended, or was stopped."""

    search: Search
    conditions: dict[str, Condition]
    complete: bool
    band: float  # volume of the band relative to X, from samples
    separating: float  # share of the states that lack passivity, in which the row of least phi has ḣ > 0
    rows: list[str]  # names of the rows that the proof is about
    mass_error: float

    @property
    def details(self) -> dict[str, Any]:
        """Counts for the certificate."""
        s = self.search
        known = self.mass_error == 0.0 and np.isfinite(s.excess)  # looked at for the model, where rows leave a torque
        return {
            "boxes": s.judged,
            "boxes_proved": s.proved,
            "share_decided": s.share,
            "volume_without_passivity": s.impassive_volume,
            "volume_undecided": s.undecided_volume,
            "band_volume": self.band,
            "largest_excess_power": s.excess if known else None,
            "mass_error": self.mass_error,
            "separating": self.separating,
            "rows": self.rows,
        }


def state_name(mass_error: float = 0.0) -> str:
    """Name of the file that holds an unfinished proof, in the barrier's folder."""
    return f"verify{suffix(mass_error)}.npz"


def obstacle_to_proof(problem: Problem, stored: StoredBarrier) -> str:
    """Why no proof can be tried, as a clause; "" if one can."""
    if problem.model.nv > JOINTS:
        return f"the robot has {problem.model.nv} joints, and proofs reach up to {JOINTS}"
    if stored.network.kind != "convex" or stored.network.energy:
        return "the proof bounds the convex network alone (`--preset default`)"
    if stored.filter["kind"] != "qp":
        return "the proof is about the QP filter, and the barrier was trained for the closed form"
    return ""


def prove(
    problem: Problem,
    stored: StoredBarrier,
    folder: Path,
    power: float,
    threads: int,
    seconds: float,
    on_round: Callable[[Search], None],
    mass_error: float = 0.0,
) -> Proof:
    """Prove, or go on with the proof in ``folder``, that the QP filter has a solution on the whole band.

    With ``mass_error``, that one torque satisfies its rows for every robot near the model.

    Args:
        problem: robot, world and controller, with the goal that u_des aims at.
        stored: its barrier.
        folder: holds the state of an unfinished proof.
        power: [W] that the passivity row is given beyond d_p.
        threads: boxes are judged by so many at once.
        seconds: after which to stop.
        on_round: called after every round of boxes.
        mass_error: largest share by which each link may be heavier or lighter, mass and inertia by the same factor.

    Raises:
        InputError: for obstacles that have no symbolic form.
        CheckFailed: if the band seems to be empty.
    """
    problem = problem.with_barrier_spec(stored.spec)
    barrier, config, passive = stored.barrier(problem), stored.filter_config(), stored.kind == "pp-ncbf"
    judge = BoxJudge(problem, stored.network, config, power, mass_error)
    q, v, tried = uniform_band(problem, barrier, MARKERS, np.random.default_rng(0))
    if not len(q):
        raise CheckFailed(f"none of {tried:,} uniform states of X lies on the band: the safe set has collapsed")
    path, identity = folder / state_name(mass_error), _identity(problem, stored, config, power, mass_error)
    search = load_search(path, identity)
    if search is None:
        markers = np.concatenate([problem.model.to_angles(q), v], axis=1)
        search = begin(judge, passive, markers)
    confirm = (
        _no_common_torque(problem, barrier, config, power, mass_error)
        if mass_error > 0.0
        else _filter_fails(problem, barrier, config, power)
    )
    run(search, judge, confirm, threads, seconds, on_round, lambda s: save_search(s, identity, path))
    if search.done:
        path.unlink(missing_ok=True)
    band = len(q) / tried
    leaving = sum(_separates(problem, barrier, x) for x in search.impassive)
    separating = leaving / max(1, len(search.impassive))
    rows = problem.safety.names[: problem.safety.rows]
    conditions = _conditions(problem, stored, search, power, band, mass_error)
    return Proof(search, conditions, search.complete, band, separating, rows, mass_error)


def _separates(problem: Problem, barrier: Barrier, x: Array) -> bool:
    """Whether the row of least phi has ``ḣ > 0`` at a state."""
    nv = problem.model.nv
    dyn = problem.model.evaluate(problem.model.from_angles(x[:nv]), x[nv:])
    safety = problem.safety.evaluate(dyn)
    return bool(safety.hdot(dyn.v)[barrier.rows(dyn, safety).phi.argmin()] > 0.0)


def _identity(problem: Problem, stored: StoredBarrier, config: FilterConfig, power: float, mass_error: float) -> str:
    """SHA-256 of all that a proof depends on."""
    about = [VERSION, stored.data["weights_sha256"], problem.fingerprint(), problem.robot.goal.tolist(), vars(config),
             stored.spec.model_dump(), stored.kind, power, mass_error]  # fmt: skip
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def _filter_fails(
    problem: Problem, barrier: Barrier, config: FilterConfig, power: float
) -> Callable[[Array, bool], bool]:
    """Whether the runtime filter has no answer at a state of the band, with its passivity row or without."""
    runtime = SafetyFilter(problem.model, problem.safety, barrier, config)

    def fails(x: Array, passive: bool) -> bool:
        nv = problem.model.nv
        dyn = problem.model.evaluate(problem.model.from_angles(x[:nv]), x[nv:])
        safety = problem.safety.evaluate(dyn)
        phi = float(barrier.rows(dyn, safety).phi.min())
        if safety.h.min() < 0.0 or not 0.0 <= phi <= barrier.spec.epsilon:
            return False
        nominal = problem.robot.controller.evaluate(dyn)
        allowed = float(nominal.d_p) + power if passive else None
        return runtime.filter(dyn, nominal.u, allowed).status >= Status.PASSIVITY_DROPPED

    def quietly(x: Array, passive: bool) -> bool:
        logger = logging.getLogger(SafetyFilter.__module__)
        level = logger.level
        logger.setLevel(logging.ERROR)  # it warns of what is sought here
        try:
            return fails(x, passive)
        finally:
            logger.setLevel(level)

    return quietly


def _no_common_torque(
    problem: Problem, barrier: Barrier, config: FilterConfig, power: float, mass_error: float
) -> Callable[[Array, bool], bool]:
    """Whether no torque at a state of the band serves all robots with every link as light or as heavy as may be.

    By the linear program over their rows together, each row's constant term and factors exact up to rounding.
    """
    nv, safety = problem.model.nv, problem.safety
    corners = [perturbed(problem.model, mass=x, inertia=x)
               for x in itertools.product((1.0 - mass_error, 1.0 + mass_error), repeat=nv)]  # fmt: skip
    u_max = np.ones(JOINTS)
    u_max[:nv] = problem.model.u_max

    def fails(x: Array, passive: bool) -> bool:
        q, v = problem.model.from_angles(x[:nv]), x[nv:]
        A, B = [], []
        for robot in corners:
            dyn = robot.evaluate(q, v)
            rows = barrier.rows(dyn, safety.evaluate(dyn))
            if rows.h.min() < 0.0 or not 0.0 <= rows.phi.min() <= barrier.spec.epsilon:
                return False
            separating = config.fast_alpha * np.maximum(0.0, np.minimum(rows.hdot, rows.phi))
            A.append(rows.Lf_phi + config.alpha * (rows.phi - config.margin) + separating)
            B.append(rows.Lg_phi)
        if passive:
            nominal = problem.robot.controller.evaluate(problem.model.evaluate(q, v))
            budget = float(nominal.d_p + v @ nominal.u) + free_power(problem.model) + power
            A.append(np.array([budget]))
            B.append(-v[None])
        constant, factors = np.concatenate(A), np.zeros((sum(map(len, A)), JOINTS))
        factors[:, :nv] = np.concatenate(B)
        weight = np.abs(factors) @ u_max + 1e-12
        return best_torque(constant, factors, weight, len(constant), u_max, np.zeros(JOINTS)) < FAIL

    return fails


def _conditions(
    problem: Problem, stored: StoredBarrier, search: Search, power: float, band: float, mass_error: float
) -> dict[str, Condition]:
    """Verdicts of all conditions."""
    epsilon, rows = stored.spec.epsilon, problem.safety.rows
    on_band = f"on the whole band {{0 <= min_k phi_k <= {epsilon:g}, h >= 0}} in X"
    if mass_error > 0.0:
        on_band += (
            f", for all robots at once whose links are each heavier or lighter by up to {100.0 * mass_error:g} %, "
            "mass and inertia by the same factor"
        )
    failed = len(search.infeasible)
    verdict = _verdict(failed, search.complete and search.undecided_volume == 0.0)
    left = search.undecided_volume + _volume(problem, search.boxes)
    share = left / band
    conditions = {
        "feasibility": Condition(
            verdict,
            f"a torque within the limits satisfies psi_k(u) >= -alpha (phi_k - margin) - fast_alpha max(0, min(hdot_k, "
            f"phi_k)) for all {rows} rows {on_band}",
            bound=min(1.0, share),
            violations=failed,
        )
    }
    if stored.kind == "pp-ncbf":
        failed = len(search.impassive)
        complete = search.complete and search.impassive_volume == search.undecided_volume == 0.0
        share = (search.impassive_volume + left) / band
        beyond = free_power(problem.model) + power
        conditions["passivity"] = Condition(
            _verdict(failed, complete),
            f"such a torque also satisfies v·(u - u_des) <= d_p + {beyond:.3g} W {on_band}",
            bound=min(1.0, share),
            violations=failed,
        )
        if stored.filter["metric"] == "kinetic":
            conditions["boundary_passivity"] = _boundary_passivity(problem, stored)
    known = verdict == "proved" and np.isfinite(search.Lg)
    conditions["Lg_phi"] = Condition(
        "proved" if known else "undecided",
        f"|L_g phi_k| of every row with phi_k <= {epsilon:g} is at least the bound {on_band}",
        bound=search.Lg if known else None,
    )
    return conditions


def _volume(problem: Problem, boxes: Array) -> float:
    """Volume of boxes (n, 2, 2 nv), relative to X."""
    domain = problem.robot.domain
    width = np.concatenate([np.ptp(domain.q, axis=1), np.ptp(domain.v, axis=1)])
    return float((np.ptp(boxes, axis=1) / width).prod(axis=-1).sum())


def _verdict(counterexamples: int, complete: bool) -> Verdict:
    return "refuted" if counterexamples else "proved" if complete else "undecided"


def _boundary_passivity(problem: Problem, stored: StoredBarrier) -> Condition:
    """Passivity of the correction on phi = 0, which the form of K_theta gives.

    ``v·w_k = ḣ_k - v·∂K/∂v = phi_k - gamma h_k - (v·∂K/∂v - K)``, and the bracket is never negative: K is a cone
    and a bowl of the velocity, convex and zero with zero slope at rest, and a sum of Bregman divergences of softplus in
    ``z_j = b_j(q)·v``, convex in z_j and zero with zero slope at z_j = 0, each times a softplus, which is positive.
    That holds for any finite weights, and loading a barrier refuses others. Random
    states tell whether the code computes that form.
    """
    rng, domain, model = np.random.default_rng(0), problem.robot.domain, problem.model
    q, v = model.from_angles(domain.sample_q(rng, RAY_STATES)), domain.sample_v(rng, RAY_STATES)
    K, _, K_v = stored.network.value_and_grad(q, v)
    slack = (v * K_v).sum(-1) - K
    holds = bool(np.all(slack >= -1e-9 * (1.0 + K)))
    return Condition(
        "proved" if holds else "refuted",
        "on phi_k = 0 every row's correction takes out power of at least gamma h_k per unit of its multiplier, "
        "v·w_k <= -gamma h_k, in the kinetic metric and while no torque limit is active: K is convex in v",
        bound=0.0,
        samples=RAY_STATES,
        violations=int(np.sum(slack < -1e-9 * (1.0 + K))),
        worst_margin=float(slack.min()),
    )


def check_symbolic(problem: Problem) -> str:
    """Why the problem has no symbolic form, as a clause; "" if it has one."""
    from ppcbf_robots.symbolic import safety_rows

    try:
        safety_rows(problem.safety)
    except InputError as error:
        return str(error)
    return ""
